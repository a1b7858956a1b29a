"""Durations and bank rows in few words."""

from __future__ import annotations

import math

from wavefocus.storage.point_status import row_ranges

__all__ = ["a_while", "hours", "row_ranges"]

_LONGEST_S = 100 * 365.25 * 86400


def a_while(seconds: float) -> str:
    """A duration that is not over, for people: as `hours`, but never 0 s."""
    return "1 s" if 0 < seconds < 1 else hours(seconds)


def hours(seconds: float) -> str:
    """A duration for people: ``2 h 05 min``, ``4 min 10 s``, ``12 s``."""
    if not math.isfinite(seconds):
        return "unknown"
    if seconds > _LONGEST_S:
        return "over 100 years"
    whole = max(0, round(seconds))
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    if whole >= 60:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole} s"
