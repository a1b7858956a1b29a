"""Emulated mirror controllers."""
