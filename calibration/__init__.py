"""From recordings to Green's functions, and the files that keep them."""
