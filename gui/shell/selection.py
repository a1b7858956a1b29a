"""Which positions of which bank are selected on the campaign's map, for tabs that work on them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(slots=True)
class Selection:
    """Shared by the tabs of one window; the Campaign tab writes it.

    Parameters
    ----------
    bank : Path or None
        The bank that is shown.
    rows : frozenset of int
        Its selected positions.
    """

    bank: Path | None = None
    rows: frozenset[int] = frozenset()
