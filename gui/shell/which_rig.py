"""Which rig a run file names, and whether a rig is in software alone, so that several programs can have it at once."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from gui.shell.toml_file import tables_of
from storage.errors import InputError

VIRTUAL = "virtual"


def is_virtual(rig: Mapping[str, object]) -> bool:
    """Whether a rig's tables name virtual instruments; either all of a rig are, or none."""
    mirror = rig.get("mirror")
    return not isinstance(mirror, Mapping) or mirror.get("driver", VIRTUAL) == VIRTUAL


def names_virtual_rig(rig: str | Path) -> bool:
    """Whether ``virtual``, or a rig file, is a virtual rig; a file that nobody can read opens no instruments either."""
    if str(rig) == VIRTUAL:
        return True
    try:
        return is_virtual(tables_of(Path(rig)))
    except InputError:
        return True


def rig_of_run(run: Path) -> Path | None:
    """The rig file that a run file names, None where it names none.

    Raises
    ------
    InputError
        The run file cannot be read, or is no TOML.
    """
    named = tables_of(run).get("rig")
    return run.parent / named if isinstance(named, str) and named != VIRTUAL else None


def runs_on_virtual_rig(run: Path) -> bool:
    """Whether a run file's campaign needs no instruments; one that nobody can read is told about by the capture."""
    try:
        rig = rig_of_run(run)
    except InputError:
        return True
    return rig is None or names_virtual_rig(rig)
