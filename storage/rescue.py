"""What becomes of a file that was deleted, replaced or truncated while it was measured."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from storage.errors import FileLostError, WavefocusError


def rescue(lost: FileLostError, path: Path, folder: os.stat_result, copy: Callable[[Path], int]) -> FileLostError:
    """Keep what a lost file still holds under another name.

    Parameters
    ----------
    lost : FileLostError
        What happened.
    path : Path
        Where the file was.
    folder : os.stat_result
        The folder that it was opened in.
    copy : callable
        Makes a file of a given name from what is still there; returns how many positions it holds.

    Returns
    -------
    FileLostError
        What happened, what was kept and how to go on; to be raised.
    """
    failures = []
    for place in _folders(path, folder):
        name = _free_name(place / path.name)
        try:
            kept = copy(name)
        except (WavefocusError, OSError) as failure:
            failures.append(str(failure))
            continue
        return FileLostError(
            f"{lost}; {kept} positions are kept in {name}; rename it to {path}, then go on with wavefocus resume"
        )
    return FileLostError(f"{lost}; what it still held could not be kept elsewhere: {'; '.join(failures)}")


def _folders(path: Path, folder: os.stat_result) -> Iterator[Path]:
    """The file's own folder, unless that is gone or another one is mounted there; then others."""
    try:
        if os.path.samestat(path.parent.stat(), folder):
            yield path.parent
    except OSError:
        pass
    yield from (Path.cwd(), Path.home(), Path(tempfile.gettempdir()))


def _free_name(path: Path) -> Path:
    number = 1
    while (name := path.with_name(f"{path.stem}.rescue{number if number > 1 else ''}{path.suffix}")).exists():
        number += 1
    return name
