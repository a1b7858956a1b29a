"""A rig from the command line: instruments, calibration, manual operation, messages."""
