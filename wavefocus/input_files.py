"""The files that a command reads: those of its command line, and those that configurations among them name."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path


def input_files(*files: Path | None) -> list[Path]:
    """List files, and the files that TOML files among them name by any key, at any depth.

    Parameters
    ----------
    *files : Path or None
        Files of the command line; None and what is missing or unreadable names nothing further.
    """
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
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
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
