"""From recordings to Green's functions."""
