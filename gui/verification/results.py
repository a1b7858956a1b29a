"""What a verification left in its folder, read for the window."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rendering.verify.names import FIELD_NAMES, PREDICTION_NAME, RECORD_NAME, REPORT_NAME, SCAN_NAME
from storage.errors import InputError

if TYPE_CHECKING:
    from gui.surface.ground import Ground
    from rendering.verify.field_pair import FieldPair
    from rendering.verify.reading import VerificationRecord

# So many instants tell how loud a field is where no focus instants are known.
_INSTANTS = 64


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """One verification.

    Parameters
    ----------
    record : VerificationRecord
        Figures, foci, sources, errors.
    pair : FieldPair
        Prediction and scan.
    ground : Ground
        What the maps are drawn over.
    focus_sample : int64 array (foci,)
        Samples of the fields at which foci were looked at.
    loudest, loudest_difference : float
        Ends of the scales for the whole scene, in response units.
    """

    record: VerificationRecord
    pair: FieldPair
    ground: Ground
    focus_sample: NDArray[np.int64]
    loudest: float
    loudest_difference: float


def read_results(record_file: Path, on_progress: Callable[[int, int], object], wanted: Callable[[], bool]) -> Results:
    """Read a verification; takes a second for some hundred megabytes.

    Raises
    ------
    InputError
        A file is missing, damaged or of something else; the message names it.
    CancelledError
        Nobody wants it any more.
    """
    from gui.surface.ground import ground_of
    from rendering.verify.field_pair import read_pair  # scipy is loaded by whoever looks at a field
    from rendering.verify.reading import read_record

    record = read_record(record_file)
    folder = record.folder
    pair = read_pair(folder / PREDICTION_NAME, folder / SCAN_NAME, record.band_hz, on_progress, wanted)
    if not np.array_equal(pair.position_index, record.position_index):
        raise InputError(
            f"{folder / PREDICTION_NAME} is of other positions than {record_file}; they are not of one verification"
        )
    focus = np.array([pair.sample_at(time_s) for time_s in record.focus_s], np.int64)
    looked_at = focus if len(focus) else np.linspace(0, pair.samples - 1, _INSTANTS).round().astype(np.int64)
    loudest, difference = pair.loudest(looked_at, record.compared)
    ground = ground_of(
        record.position_mm, record.actuator_mm, record.outline_mm, [source.path_mm for source in record.sources]
    )
    return Results(record, pair, ground, focus, loudest, difference)


def record_of(path: Path) -> Path | None:
    """The record of the verification that a file or folder belongs to; None when it is of none."""
    if path.is_dir():
        return path / RECORD_NAME if (path / RECORD_NAME).is_file() else None
    if path.suffix.lower() == ".json":  # a record may have been given another name
        return path
    beside = path.with_name(RECORD_NAME)
    return beside if path.name in (*FIELD_NAMES, REPORT_NAME) and beside.is_file() else None
