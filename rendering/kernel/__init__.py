"""The bank between its positions by kernel ridge regression over the waves that the bank itself shows."""
