"""Plates: how a wave leaves a small source and what arrives at a distance."""
