"""Records into Green's functions."""
