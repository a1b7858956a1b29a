"""Durations and times in few words."""

import math
from datetime import UTC, datetime, timedelta

_MAX_S = 100 * 365.25 * 86400
# Further than any campaign goes, and well within the range of dates.
MAX_AHEAD_S = 1000 * 365.25 * 86_400


def a_while(seconds: float) -> str:
    """A duration that is not over, for people: as `hours`, but never 0 s."""
    return "1 s" if 0 < seconds < 1 else hours(seconds)


def hours(seconds: float) -> str:
    """A duration for people: ``2 h 05 min``, ``4 min 10 s``, ``12 s``."""
    if not math.isfinite(seconds):
        return "unknown"
    if seconds > _MAX_S:
        return "over 100 years"
    whole = max(0, round(seconds))
    if whole >= 3600:
        return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    if whole >= 60:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole} s"


def finish_time(remaining_s: float, now: datetime) -> datetime:
    """The local time `remaining_s` seconds after an instant, also where clocks change between the two."""
    # Added in UTC and converted last: a local time keeps its offset when something is added to it.
    return (now.astimezone(UTC) + timedelta(seconds=min(remaining_s, MAX_AHEAD_S))).astimezone()
