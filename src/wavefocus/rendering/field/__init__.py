"""Drives into fields, and figures of fields."""
