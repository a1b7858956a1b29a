"""Recorders of the reference and the response: one module for each driver."""
