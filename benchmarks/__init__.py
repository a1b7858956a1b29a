"""Error against run time, ours beside peers, in one run."""
