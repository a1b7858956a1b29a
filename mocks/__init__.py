"""Stand-ins for a rig: `plates`, a `virtual` rig without wires, and emulated devices on wires (`wire`)."""
