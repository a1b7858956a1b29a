"""Warnings about files without checksums."""

from __future__ import annotations

from pathlib import Path

from wavefocus.console import say


def name_unverified(path: Path, *, verified: bool) -> None:
    """Warn of a drive or field file that does not carry checksums of all its values."""
    if not verified:
        say(f"warning: {path} carries no checksums (contract 1.1): its values are unverified")
