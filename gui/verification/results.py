"""Files of a verification: its kind when dropped, its record, and its fields as the window shows them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gui.surface import Surface, raster_of
from gui.toml_files import TomlKind, toml_kind
from rendering.verify.record import FIELD_NAMES, PREDICTION_NAME, RECORD_NAME, REPORT_NAME, SCAN_NAME
from storage.errors import InputError

if TYPE_CHECKING:
    from rendering.verify.field_pair import FieldPair
    from rendering.verify.record import VerificationRecord

# Number of instants that give the largest response where no focus instants are known.
_INSTANTS = 64


class Dropped(Enum):
    """Kinds of dropped files."""

    RECORD = auto()
    SCENE = auto()
    RIG = auto()
    BANK = auto()
    FOLDER = auto()
    OTHER = auto()


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """One verification.

    Parameters
    ----------
    folder : Path
        Folder of prediction, scan and report.
    record : VerificationRecord
        Figures, foci, sources, errors.
    pair : FieldPair
        Prediction and scan.
    surface : Surface
        What the maps are drawn over.
    focus_sample : int64 array (foci,)
        Samples of the fields at which foci were looked at.
    loudest, loudest_difference : float
        Ends of the scales for the whole scene, in response units.
    """

    folder: Path
    record: VerificationRecord
    pair: FieldPair
    surface: Surface
    focus_sample: NDArray[np.int64]
    loudest: float
    loudest_difference: float


def read_results(record_file: Path, on_progress: Callable[[int, int], object], wanted: Callable[[], bool]) -> Results:
    """Read a verification; takes a second for some hundred megabytes.

    Raises
    ------
    InputError
        A file is missing, damaged or of another verification; the message names it.
    CancelledError
        `wanted` returned False.
    """
    from rendering.verify.field_pair import read_pair  # the window starts without scipy
    from rendering.verify.record import read_record

    record = read_record(record_file)
    folder = record_file.parent
    pair = read_pair(folder / PREDICTION_NAME, folder / SCAN_NAME, record.band_hz, on_progress, wanted)
    if not np.array_equal(pair.position_index, record.position_index):
        raise InputError(
            f"{folder / PREDICTION_NAME} has other positions than {record_file}; run the verification again"
        )
    focus = np.array([pair.sample_at(time_s) for time_s in record.focus_s], np.int64)
    looked_at = focus if len(focus) else np.linspace(0, pair.samples - 1, _INSTANTS).round().astype(np.int64)
    loudest, difference = pair.loudest(looked_at, record.compared)
    surface = Surface(
        record.position_mm, record.actuator_places_mm,
        None if record.outline_mm is None else np.array(record.outline_mm), raster_of(record.position_mm, gaps=False),
        [np.array(source.path_mm) for source in record.sources],
    )  # fmt: skip
    return Results(folder, record, pair, surface, focus, loudest, difference)


def record_of(path: Path) -> Path | None:
    """Return the record of the verification that a file or folder belongs to; None for any other file."""
    if path.is_dir():
        return path / RECORD_NAME if (path / RECORD_NAME).is_file() else None
    if path.suffix.lower() == ".json":  # a record may have been renamed
        return path
    sidecar = path.with_name(RECORD_NAME)
    return sidecar if path.name in (*FIELD_NAMES, REPORT_NAME) and sidecar.is_file() else None


def dropped_kind(path: Path) -> Dropped:
    """Return what a dropped file or folder is, by its content."""
    if record_of(path) is not None:
        return Dropped.RECORD
    if path.is_dir():
        return Dropped.FOLDER
    name = path.name.lower()
    if name.endswith(".h5") and not name.endswith(".raw.h5"):
        return Dropped.BANK
    if not name.endswith(".toml"):
        return Dropped.OTHER
    return {TomlKind.SCENE: Dropped.SCENE, TomlKind.RIG: Dropped.RIG}.get(toml_kind(path), Dropped.OTHER)
