"""Position, width and artefacts of a scene's foci, from predictions at chosen instants."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gui.scene.messages import FocusFigures, between
from rendering.field.crosstalk import PathResponses
from rendering.field.foci import LoudestInstants
from rendering.field.focus_figures import FOCUS_RADIUS_MM, FocusInstant, evenly
from rendering.field.metrics import focus_spot, grid_spacing_mm
from rendering.scene.model import Scene
from storage.bank.reading import Bank
from storage.drive_file import Drive
from storage.errors import InputError

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

MOST_FIGURES = 8
MOST_CROSSTALK_POINTS = 24
MOST_CROSSTALK_SOURCES = 4


@dataclass(frozen=True, slots=True, eq=False)
class Snapshots:
    """The field at the instants of some of the foci; NaN beyond its end.

    Parameters
    ----------
    instants : list of FocusInstant, length K
    time_s : float64 array, shape (K,)
    values : float32 array, shape (K, positions)
    """

    instants: list[FocusInstant]
    time_s: Float64Array
    values: Float32Array

    @classmethod
    def of(cls, looked: LoudestInstants, drive: Drive, field: Float32Array, field_rate_hz: float) -> Snapshots:
        """Take snapshots of a field, shape (samples, positions)."""
        instants = [looked.instants[index] for index in evenly(len(looked.instants), MOST_FIGURES)]
        time_s = np.array([one.sample for one in instants]) / drive.sample_rate_hz
        values = np.full((len(instants), field.shape[1]), np.nan, np.float32)
        for index, place in enumerate(((time_s - drive.start_s) * field_rate_hz).tolist()):
            if place <= len(field) - 1:
                values[index] = between(field, place)
        return cls(instants, time_s, values)


def focus_figures(
    number: int, snapshots: Snapshots, rows: Int64Array, bank: Bank, scene: Scene, drive: Drive,
    check: Callable[[], None],
) -> FocusFigures:  # fmt: skip
    """Compute the figures; `check` is called between them, and what it raises ends the work."""
    position_mm = np.asarray(bank.position_mm, np.float64)
    there, count = position_mm[rows], len(snapshots.instants)
    peak, off_mm, width_mm, artefact_db = np.full((4, count), np.nan)
    spacing_mm = grid_spacing_mm(there) if len(there) > 1 else None
    for index, one in enumerate(snapshots.instants):
        check()
        field, point = snapshots.values[index], position_mm[one.row]
        if np.isfinite(field).all() and (found := focus_spot(there, field, point, FOCUS_RADIUS_MM, spacing_mm)):
            peak[index], off_mm[index] = abs(found.value), found.off_mm
            width_mm[index], artefact_db[index] = found.width_mm, found.artefact_db
    crosstalk = []
    for source in range(min(len(scene.sources), MOST_CROSSTALK_SOURCES)):
        check()
        ratio = crosstalk_of(scene, source, bank, drive)
        if math.isfinite(ratio):
            crosstalk.append((source, ratio))
    return FocusFigures(number, snapshots.time_s, peak, off_mm, width_mm, artefact_db, tuple(crosstalk))


def crosstalk_of(scene: Scene, index: int, bank: Bank, drive: Drive) -> float:
    """Crosstalk along the middle of a source's path, as a ratio of amplitudes; NaN where it has but one point.

    Every path point emits the source's signal where it emits per point, else one impulse.
    """
    source = scene.sources[index]
    rows: Sequence[int] = drive.focus_position[drive.focus_source == index].tolist()
    if len(rows) < 2 or source.speed_mm_s <= 0:
        return math.nan
    begin = (len(rows) - min(len(rows), MOST_CROSSTALK_POINTS)) // 2
    signal = source.signal.samples(bank.sample_rate_hz) if source.emission == "per_point" else None
    try:
        responses = PathResponses(bank, rows[begin : begin + MOST_CROSSTALK_POINTS], signal, scene.regularisation)
    except InputError:
        return math.nan  # the emission is too long to be compared point by point
    return math.sqrt(responses.energy_ratio(source.speed_mm_s, source.step_mm))
