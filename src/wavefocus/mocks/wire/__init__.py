"""Emulated devices that real drivers talk to: `emulated_rig.EmulatedRig`, or each device by itself."""
