"""Scenes into drives."""
