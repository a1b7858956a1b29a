"""Checks of finished files: checksums, physical sanity, rows against their neighbours."""
