"""Instruments: what each role must do, and the drivers that do it."""
