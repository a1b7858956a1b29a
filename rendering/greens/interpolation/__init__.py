"""The bank between its grid positions: interpolation methods, their errors, and the grid that a band needs."""
