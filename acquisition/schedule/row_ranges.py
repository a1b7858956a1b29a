"""Rows of a bank in few words."""

from __future__ import annotations

from collections.abc import Sequence


def row_ranges(rows: Sequence[int]) -> str:
    """Bank rows as ``--positions`` takes them: ``"3,5-9"``."""
    ranges: list[list[int]] = []
    for row in sorted(set(rows)):
        if ranges and row == ranges[-1][1] + 1:
            ranges[-1][1] = row
        else:
            ranges.append([row, row])
    return ",".join(f"{first}-{last}" if last > first else f"{first}" for first, last in ranges)
