"""Plates and virtual instruments that stand in for a rig."""
