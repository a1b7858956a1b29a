"""A virtual rig without wires: `rig.VirtualRig`, `settings.VirtualSettings`, `faults.Fault`."""
