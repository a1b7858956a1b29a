"""Units as people read them: a prefix instead of many zeros."""

from __future__ import annotations

import math

# Units that take a prefix; those of other banks are shown as they are.
_TAKE_PREFIX = ("m/s", "m", "m/s²", "m/s^2", "V")
_PREFIXES = ((1.0, ""), (1e3, "m"), (1e6, "µ"), (1e9, "n"))


def shown_unit(unit: str, largest: float) -> tuple[float, str]:
    """Factor and unit that make the largest value of a scale a number above one, where a prefix can do that."""
    if unit not in _TAKE_PREFIX or not (math.isfinite(largest) and largest > 0.0):
        return 1.0, unit
    for factor, prefix in _PREFIXES:
        if largest * factor >= 1.0:
            return factor, prefix + unit
    return _PREFIXES[-1][0], _PREFIXES[-1][1] + unit
