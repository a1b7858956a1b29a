"""Data acquisition: recorders of the reference and the response."""
