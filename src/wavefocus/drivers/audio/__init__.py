"""Players: one module for each driver; `resampling` converts signals to an interface's rate."""
