"""Child processes, background work and logs that the window follows."""
