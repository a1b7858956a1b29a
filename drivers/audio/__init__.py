"""Audio interfaces: a stream in a process of its own, and signals at the interface's rate."""
