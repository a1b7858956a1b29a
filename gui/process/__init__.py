"""Child processes and background work of the window."""
