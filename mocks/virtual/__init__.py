"""A virtual rig: three instruments, one plate and one clock, without wires."""
