"""The far sides of the wires: what real drivers talk to when there is no hardware."""
