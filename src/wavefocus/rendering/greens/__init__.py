"""The bank as the renderer reads it: rows, regularisation, interpolation."""
