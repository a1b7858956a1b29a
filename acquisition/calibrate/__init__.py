"""Calibration procedures: they use roles and an operator, no device and no window."""
