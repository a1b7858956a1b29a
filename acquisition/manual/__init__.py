"""Measuring by hand: live level, single sweeps."""
