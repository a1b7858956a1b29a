"""Vibrometer controllers that can be asked for their settings: one module for each."""
