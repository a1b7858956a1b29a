"""``verify.json``: the record of a verification for programs, and the names of the files in its folder."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wavefocus.config.messages import Instant, Message, MessageError, Number, from_record, tag, to_record
from wavefocus.rendering.arrays import BoolArray, Float64Array, Int64Array
from wavefocus.rendering.verify.results import (
    ActuatorFigures,
    Correction,
    Figure,
    PointMm,
    SentinelDrift,
    Symptom,
    with_words,
)
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import write_whole
from wavefocus.storage.text_file import read_regular

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource
    from wavefocus.rendering.scene.model import Scene, Source
    from wavefocus.rendering.verify.verdict import Verification
    from wavefocus.storage.field_file import Field

DRIVE_NAME = "drive.h5"
CORRECTED_NAME = "drive-corrected.h5"
PREDICTION_NAME = "prediction.h5"
SCAN_NAME = "scan.h5"
FIELD_NAMES = (DRIVE_NAME, PREDICTION_NAME, SCAN_NAME)
REPORT_NAME = "report.html"
PICTURE_NAMES = tuple(
    f"{name}.png"
    for name in ("path", "snapshots", "waveforms", "positions", "snr", "error", "gain", "drive", "drift", "waves")
)
RECORD_NAME = "verify.json"
VERSION = 1
LOG_NAME = "verify.events.jsonl"
"""Progress, while it works."""
JOURNAL_NAME, QUIET_JOURNAL_NAME = "scan.unfinished", "linearity.unfinished"
"""The positions scanned so far, until the verification is done; and those of the quieter scan."""
STOP_NAME = "verify.stop"
"""A file of this name ends the verification: outputs muted, mirror parked."""

PATH_POINTS = 401
"""Points of a recorded path: it looks smooth on any screen."""


@dataclass(frozen=True)
class _RecordedFocus:
    """A focus instant that was compared: the grid position used, and the path point that was asked for."""

    source: int
    position: int
    time_s: float
    at_mm: PointMm


@dataclass(frozen=True)
class RecordedSource:
    """Path of a source: evenly along `path_mm` from `start_s` to `stop_s`."""

    start_s: float
    stop_s: float
    path_mm: tuple[PointMm, ...]

    def at_mm(self, time_s: float) -> Float64Array | None:
        """Its place, None before it starts; at rest at the end of its path after that."""
        if time_s < self.start_s:
            return None
        times_s = np.linspace(self.start_s, self.stop_s, len(self.path_mm))
        return np.array([np.interp(time_s, times_s, along_mm) for along_mm in np.array(self.path_mm).T])


@dataclass(frozen=True)
class _RecordedPositions:
    """Bank rows of the predicted positions, their places, and the errors there, NaN where nothing was compared."""

    index: tuple[int, ...]
    at_mm: tuple[PointMm, ...]
    error: tuple[Number, ...]
    correlation: tuple[Number, ...]


@dataclass(frozen=True)
class _ExcludedPosition:
    """A scanned bank row that was not compared, and why."""

    position: int
    reason: str


class VerificationRecord(Message, frozen=True, dict=True, tag_field="format", tag="wavefocus-verification"):
    """The content of ``verify.json``, and the same as arrays.

    scene_file, bank, rig: Names on the command line.
    passed: No figure is beyond its limit, and there is no symptom.
    band_hz: To which both fields were limited; None: not limited.
    figures: Those with a limit first.
    outline_mm: Rim of the surface, closed.
    actuator_mm: None where a place is unknown.
    symptoms: What is wrong, the largest cause first.
    actuators: Of each actuator against the bank; records of before have none.
    drift: Of the bank's sentinel position; None where it was not measured again.
    correction: Of the drive by further scans; None where none was asked for.
    """

    format_version: int
    made: Instant
    scene: str
    scene_file: str
    bank: str
    rig: str
    passed: bool
    summary: str
    response_unit: str
    band_hz: tuple[float, float] | None
    spacing_mm: float | None
    figures: tuple[Figure, ...]
    foci: tuple[_RecordedFocus, ...]
    sources: tuple[RecordedSource, ...]
    outline_mm: tuple[PointMm, ...] | None
    actuator_mm: tuple[PointMm | None, ...]
    positions: _RecordedPositions
    excluded: tuple[_ExcludedPosition, ...]
    symptoms: tuple[Symptom, ...] = ()
    actuators: tuple[ActuatorFigures, ...] = ()
    drift: SentinelDrift | None = None
    correction: Correction | None = None

    @cached_property
    def position_index(self) -> Int64Array:
        """Bank rows of the predicted positions, (positions,)."""
        return np.array(self.positions.index, np.int64)

    @cached_property
    def position_mm(self) -> Float64Array:
        """Their places, (positions, 2)."""
        return np.array(self.positions.at_mm, np.float64)

    @cached_property
    def position_error(self) -> Float64Array:
        """Relative error at each, (positions,); NaN where nothing was compared."""
        return np.array(self.positions.error, np.float64)

    @cached_property
    def position_correlation(self) -> Float64Array:
        """Correlation at each, (positions,); NaN where nothing was compared."""
        return np.array(self.positions.correlation, np.float64)

    @property
    def focus_s(self) -> list[float]:
        """Focus instants that were compared."""
        return [focus.time_s for focus in self.foci]

    @property
    def compared(self) -> BoolArray:
        """Positions that were compared, bool array (positions,)."""
        return np.isfinite(self.position_error)

    @property
    def actuator_places_mm(self) -> Float64Array:
        """Places of the actuators, (actuators, 2); NaN where unknown."""
        return np.array([point or (math.nan, math.nan) for point in self.actuator_mm], np.float64).reshape(-1, 2)


def write_record(
    out_dir: Path,
    *,
    verification: Verification,
    scene: Scene,
    prediction: Field,
    bank: GreenSource,
    names: Mapping[str, str],
    outline_mm: Float64Array | None = None,
) -> dict[str, Any]:
    """Write ``verify.json`` into the verification's folder; an older one is replaced when the new one is whole.

    Returns its content. `names` are those of scene file, bank and rig on the command line; `outline_mm` is the rim of
    the surface, closed.
    """
    compared = verification.fields
    rows = np.asarray(prediction.position_index, np.int64)
    position_mm = np.asarray(bank.position_mm, np.float64)

    def of_rows(values: Float64Array) -> tuple[float, ...]:
        by_row = dict(zip(compared.position_index.tolist(), values.tolist(), strict=True))
        return tuple(by_row.get(row, math.nan) for row in rows.tolist())

    errors, correlations = of_rows(compared.position_error), of_rows(compared.position_correlation)
    record = VerificationRecord(
        VERSION,
        made=datetime.now(UTC).replace(microsecond=0),
        scene=scene.name,
        **names,
        passed=verification.passed,
        summary=verification.summary,
        response_unit=compared.response_unit,
        band_hz=compared.band_hz,
        spacing_mm=verification.spacing_mm,
        figures=verification.figures,
        foci=tuple(
            _RecordedFocus(instant.source, instant.row, instant.sample / compared.sample_rate_hz, place_mm)
            for instant, place_mm in zip(compared.instant, _points(verification.focus.intended_mm), strict=True)
        ),
        sources=tuple(_recorded(source) for source in scene.sources),
        outline_mm=None if outline_mm is None else _points(np.round(outline_mm, 3)),
        actuator_mm=tuple(
            point if np.isfinite(point).all() else None for point in _points(np.asarray(bank.actuator_mm, np.float64))
        ),
        positions=_RecordedPositions(tuple(rows.tolist()), _points(position_mm[rows]), errors, correlations),
        excluded=tuple(_ExcludedPosition(row, reason) for row, reason in compared.excluded),
        symptoms=verification.symptoms,
        actuators=verification.actuators,
        drift=verification.drift,
        correction=verification.correction,
    )
    content: dict[str, Any] = to_record(record)
    content["symptoms"] = [with_words(symptom) for symptom in content["symptoms"]]
    write_whole(out_dir / RECORD_NAME, json.dumps(content, allow_nan=False, indent=1) + "\n")
    return content


def _recorded(source: Source) -> RecordedSource:
    line_mm = path_line_mm(source, PATH_POINTS if source.travel_s else 1)
    return RecordedSource(source.start_s, source.start_s + source.travel_s, _points(np.round(line_mm, 3)))


def _points(places_mm: Float64Array) -> tuple[PointMm, ...]:
    return tuple((x, y) for x, y in places_mm.tolist())


def path_line_mm(source: Source, points: int) -> Float64Array:
    """So many points evenly along a source's path, its start where it is one."""
    return np.asarray(source.path.point_at(np.linspace(0.0, source.path.length_mm, points)), np.float64)


def read_record(path: Path) -> VerificationRecord:
    """Read ``verify.json``; raises InputError where it is missing, damaged or of another format or version."""
    try:
        content = json.loads(read_regular(path))
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; wavefocus verify writes it when a verification is done") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError):
        raise InputError(f"{path} is no JSON file, or is damaged; run the verification again") from None
    if not isinstance(content, dict) or content.get("format") != tag(VerificationRecord):
        raise InputError(f"{path} is not the record of a verification: its format is not {tag(VerificationRecord)}")
    if content.get("format_version") != VERSION:
        raise InputError(
            f"{path}: format_version is {content.get('format_version')!r}; this program reads {VERSION}, a newer "
            "wavefocus wrote it"
        )
    try:
        record = from_record(VerificationRecord, content)
        _check(record)
    except MessageError as wrong:
        raise InputError(f"{path} is damaged: {wrong}; run the verification again") from wrong
    return record


def _check(record: VerificationRecord) -> None:
    count = len(record.positions.index)
    for name in ("at_mm", "error", "correlation"):
        if len(getattr(record.positions, name)) != count:
            raise MessageError(f"positions.{name} has other than {count} entries")
    if not count or not np.isfinite(record.position_mm).all():
        raise MessageError("positions.at_mm is not a list of points [x, y]")
    if not all(len(source.path_mm) and np.isfinite(source.path_mm).all() for source in record.sources):
        raise MessageError("sources.path_mm is not a list of points [x, y]")
