"""Files and positions that a command line names."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wavefocus.console import say, spinner
from wavefocus.storage.errors import InputError
from wavefocus.storage.text_file import read_text

if TYPE_CHECKING:
    from wavefocus.rendering.scene.model import Scene
    from wavefocus.storage.bank.reading import Bank


def input_files(*files: Path | None) -> list[Path]:
    """List files, and the files that TOML files among them name by any key, at any depth."""
    found: list[Path] = []
    left = [file for file in files if file is not None]
    while left:
        file = left.pop()
        if file in found:
            continue
        found.append(file)
        if file.suffix == ".toml":
            left += _named_by(file)
    return found


def _named_by(file: Path) -> list[Path]:
    from wavefocus.config.loading import parse_toml  # loads pydantic, which no command without TOML files waits for

    try:
        content = parse_toml(read_text(file), str(file))
        return [path for text in _texts(content) if (path := file.parent / text).is_file()]
    except (OSError, ValueError, RecursionError):
        return []


def _texts(value: object) -> Iterator[str]:
    if isinstance(value, dict):
        for one in value.values():
            yield from _texts(one)
    elif isinstance(value, list):
        for one in value:
            yield from _texts(one)
    elif isinstance(value, str) and value and "\0" not in value:
        yield value


def parse_positions(text: str, count: int) -> list[int]:
    """Bank rows from ``"3,5-9,12"``.

    Returns rows in the order given, each once. Raises InputError: something that is no row number, or one outside
    0..count-1.
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


def scan_rows(
    positions: str,
    scene: Scene,
    position_mm: NDArray[np.float32 | np.float64],
    scene_file: Path,
    check: NDArray[np.bool_] | None = None,
) -> list[int] | None:
    """Bank rows to scan: all (None), those that are named, one of every few, or those that the scene needs.

    Raises InputError: `positions` is something else, or the scene leaves the grid.
    """
    count = len(position_mm)
    if not positions:
        return None
    if positions == "path":
        from wavefocus.rendering.scene.scene_rows import scene_rows  # with it comes what renders

        try:
            return [int(row) for row in scene_rows(scene, np.asarray(position_mm, np.float64), check).all]
        except InputError as wrong:
            raise InputError(f"{scene_file}: {wrong}") from None
    if positions.startswith("every:"):
        step = positions.removeprefix("every:")
        if not (step.isascii() and step.isdecimal() and len(step) < 10 and 0 < int(step) <= count):
            raise InputError(f"--positions: {positions} is not every:N with N from 1 to {count}")
        return list(range(0, count, int(step)))
    return parse_positions(positions, count)


def name_unverified(path: Path, *, verified: bool) -> None:
    """Warn of a drive or field file that does not carry checksums of all its values."""
    if not verified:
        say(f"warning: {path} carries no checksums: its values are unverified")


def require_sound(bank: Bank) -> None:
    """Verify the rows of a bank as `Bank.require_sound` does, and say so on a terminal while it lasts."""
    with spinner("verifying the rows of the bank"):
        bank.require_sound()
