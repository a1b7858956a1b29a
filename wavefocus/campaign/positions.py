"""Lists of bank rows as people type them."""

from __future__ import annotations

import re

from storage.errors import InputError


def parse_positions(text: str, count: int) -> list[int]:
    """Bank rows from ``"3,5-9,12"``.

    Parameters
    ----------
    text : str
        Row numbers from 0, single or as ranges with both ends included, commas between.
    count : int
        How many positions the bank has.

    Returns
    -------
    list of int
        Rows in the order given, each once.

    Raises
    ------
    InputError
        Something that is no row number, or one outside 0..count-1.
    """
    rows: dict[int, None] = {}
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,9})\s*(?:-\s*(\d{1,9})\s*)?", part)
        if match is None:
            raise InputError(f"--positions: {part.strip()!r} is no row number; allowed: 0 to {count - 1}, as 3,5-9")
        first = int(match[1])
        last = int(match[2]) if match[2] else first
        if last < first or last >= count:
            raise InputError(f"--positions: {part.strip()} is outside the bank's rows 0 to {count - 1}")
        rows.update(dict.fromkeys(range(first, last + 1)))
    return list(rows)
