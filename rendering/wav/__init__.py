"""Drives as sound files at an audio interface's rate."""
