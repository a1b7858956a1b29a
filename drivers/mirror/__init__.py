"""Scanning mirrors on serial lines."""
