"""Numbers as devices read them."""

from __future__ import annotations

import re

NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)")


def number(text: str | None) -> float | None:
    """The number that a text is, or None."""
    return float(text) if text is not None and NUMBER.fullmatch(text) else None
