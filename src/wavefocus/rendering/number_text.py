"""Numbers as text: three digits, the unit, a dash where there is none; the first of many."""

import math
from collections.abc import Sequence

_NAMED = 8


def number(value: float | None, unit: str = "") -> str:
    """Three digits and the unit; a dash where there is no value."""
    if value is None or math.isnan(value):
        return "\N{EN DASH}"
    if math.isinf(value):
        text = "\N{INFINITY}" if value > 0 else "\N{MINUS SIGN}\N{INFINITY}"
    else:
        # None of these figures is more certain than a hundredth of a millimetre or of a decibel.
        digits = ".2f" if unit in ("mm", "dB") and abs(value) < 10 else ".3g"
        text = f"{value:{digits}}" if abs(value) < 1000 else f"{value:,.0f}"
        text = text.removeprefix("-") if not text.strip("-0.") else text
        text = text.replace("-", "\N{MINUS SIGN}")
    return text if unit == "1" else f"{text} {unit}".rstrip()


def listed(items: Sequence[int]) -> str:
    """The first of some numbers, and how many more there are."""
    shown = ", ".join(map(str, items[:_NAMED]))
    return shown if len(items) <= _NAMED else f"{shown} and {len(items) - _NAMED} more"


def precise(value: float | None) -> str:
    """A correlation, which differs from 1 in its last digits only."""
    return number(value) if value is None or math.isnan(value) else f"{value:.4f}".replace("-", "\N{MINUS SIGN}")


def percent(value: float | None) -> str:
    """A ratio of amplitudes in per cent and dB."""
    if value is None or math.isnan(value):
        return number(None)
    if not (value > 0.0 and math.isfinite(value)):
        return number(100.0 * value, "%")
    return f"{number(100.0 * value, '%')} ({number(20.0 * math.log10(value), 'dB')})"
