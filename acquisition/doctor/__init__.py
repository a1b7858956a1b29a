"""The doctor: every instrument examined."""
