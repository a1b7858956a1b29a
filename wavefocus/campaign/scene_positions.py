"""The positions of a plan that some scenes need."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rendering.scene.loading import load_scene
from rendering.scene.scene_rows import scene_rows
from storage.errors import InputError


def needed_by(
    scene_files: Sequence[Path], position_mm: NDArray[np.float64], *, checks: bool, allow_large: bool = False
) -> frozenset[int]:
    """Rows of a grid that scenes are rendered from and, if asked for, those that their checks look at.

    Parameters
    ----------
    scene_files : sequence of Path
        The scenes.
    position_mm : float64 array, shape (positions, 2)
        The grid in millimetres.
    checks : bool
        Whether the scenes shall be verified.
    allow_large : bool
        Whether scenes may be larger than the limits of `rendering.scene.size`.

    Raises
    ------
    InputError
        A scene file is wrong, or its paths leave the grid; the message names the file.
    """
    needed: set[int] = set()
    for file in scene_files:
        scene = load_scene(file, allow_large=allow_large)
        try:
            rows = scene_rows(scene, position_mm)
        except InputError as wrong:
            raise InputError(f"{file}: {wrong}") from None
        needed.update(int(row) for row in (rows.all if checks else rows.path))
    return frozenset(needed)
