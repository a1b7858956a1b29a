"""Drives of sources whose positions arrive while they sound."""
