"""Reading ``verify.json``: whatever another program did to it is a sentence."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendering.verify.names import FORMAT, VERSION
from storage.errors import InputError

Float64Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RecordedFigure:
    """One figure of a verification.

    Parameters
    ----------
    name, unit, definition : str
        What it is.
    predicted, scanned, difference : float or None
        Both sides and what lies between them; None where a figure has no such side.
    value : float or None
        What is held against the limit; None where the positions needed were not scanned.
    limit : float or None
        None where it is only told.
    relation : str
        ``"at most"`` or ``"at least"``; empty without a limit.
    passed : bool or None
        Whether it keeps to the limit; None where nothing was judged.
    """

    name: str
    unit: str
    definition: str
    predicted: float | None
    scanned: float | None
    difference: float | None
    value: float | None
    limit: float | None
    relation: str
    passed: bool | None


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSource:
    """Where a source was: evenly along `path_mm`, shape (points, 2), from `start_s` to `stop_s`."""

    start_s: float
    stop_s: float
    path_mm: Float64Array

    def at_mm(self, time_s: float) -> Float64Array | None:
        """Its place, None before it starts; at rest at the end of its path after that."""
        if time_s < self.start_s:
            return None
        if len(self.path_mm) == 1 or self.stop_s <= self.start_s:
            return np.asarray(self.path_mm[-1], np.float64)
        share = min((time_s - self.start_s) / (self.stop_s - self.start_s), 1.0) * (len(self.path_mm) - 1)
        first = min(int(share), len(self.path_mm) - 2)
        between = share - first
        return np.asarray((1.0 - between) * self.path_mm[first] + between * self.path_mm[first + 1], np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class VerificationRecord:
    """What ``verify.json`` holds.

    Parameters
    ----------
    path : Path
        The file.
    made : datetime or None
        When, with a time zone.
    scene, scene_file, bank, rig : str
        What was verified.
    passed : bool
        Whether no figure is beyond its limit.
    summary : str
        The verdict in a sentence or two.
    response_unit : str
        Of the fields.
    band_hz : tuple of float or None
        To which both fields were limited.
    figures : tuple of RecordedFigure
        Those with a limit first.
    focus_s : float64 array (foci,)
        Instants at which foci were looked at.
    sources : tuple of RecordedSource
        Of the scene.
    outline_mm : float64 array (points, 2) or None
        Rim of the surface.
    actuator_mm : float64 array (actuators, 2)
        NaN where unknown.
    position_index : int64 array (positions,)
        Bank rows of the predicted positions.
    position_mm : float64 array (positions, 2)
        Where they are.
    position_error, position_correlation : float64 array (positions,)
        NaN where nothing was compared.
    excluded : mapping of int to str
        Scanned bank rows that were not compared, and why.
    """

    path: Path
    made: datetime | None
    scene: str
    scene_file: str
    bank: str
    rig: str
    passed: bool
    summary: str
    response_unit: str
    band_hz: tuple[float, float] | None
    figures: tuple[RecordedFigure, ...]
    focus_s: Float64Array
    sources: tuple[RecordedSource, ...]
    outline_mm: Float64Array | None
    actuator_mm: Float64Array
    position_index: NDArray[np.int64]
    position_mm: Float64Array
    position_error: Float64Array
    position_correlation: Float64Array
    excluded: dict[int, str]

    @property
    def compared(self) -> NDArray[np.bool_]:
        """Which positions were compared, bool array (positions,)."""
        return np.isfinite(self.position_error)

    @property
    def folder(self) -> Path:
        """Where prediction, scan and report lie."""
        return self.path.parent


def read_record(path: Path) -> VerificationRecord:
    """Read ``verify.json``.

    Raises
    ------
    InputError
        The file is missing, damaged, of another format or version, or something in it is wrong.
    """
    content = _object(path)
    try:
        return _record(path, content)
    except (KeyError, TypeError, ValueError, AttributeError) as wrong:
        what = f"{wrong.args[0]} is missing" if isinstance(wrong, KeyError) else str(wrong)
        raise InputError(f"{path} is damaged: {what}; run the verification again") from wrong


def _object(path: Path) -> dict[str, Any]:
    """The JSON object, of this format and version; all else in it is still to be looked at."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; wavefocus verify writes it when a verification is done") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError):
        raise InputError(f"{path} is no JSON file, or is damaged; run the verification again") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"{path} is not the record of a verification: its format is not {FORMAT}")
    if content.get("format_version") != VERSION:
        raise InputError(
            f"{path}: format_version is {content.get('format_version')!r}; this program reads {VERSION}, a newer "
            "wavefocus wrote it"
        )
    return content


def _record(path: Path, content: dict[str, Any]) -> VerificationRecord:
    positions = content["positions"]
    index = np.asarray(positions["index"])
    if index.ndim != 1 or not len(index) or index.dtype.kind != "i":
        raise ValueError("positions.index is no list of bank rows")
    band = content["band_hz"]
    outline_mm = content["outline_mm"]
    return VerificationRecord(
        path=path,
        made=datetime.fromisoformat(content["made"]),
        scene=str(content["scene"]),
        scene_file=str(content.get("scene_file", "")),
        bank=str(content.get("bank", "")),
        rig=str(content.get("rig", "")),
        passed=bool(content["passed"]),
        summary=str(content["summary"]),
        response_unit=str(content["response_unit"]),
        band_hz=None if band is None else (float(band[0]), float(band[1])),
        figures=tuple(_figure(one) for one in content["figures"]),
        focus_s=_floats([one["time_s"] for one in content["foci"]], "foci", None),
        sources=tuple(
            RecordedSource(float(one["start_s"]), float(one["stop_s"]), _points(one["path_mm"], "sources.path_mm"))
            for one in content["sources"]
        ),
        outline_mm=None if outline_mm is None else _points(outline_mm, "outline_mm"),
        actuator_mm=np.array(
            [[math.nan, math.nan] if point is None else [float(point[0]), float(point[1])]
             for point in content["actuator_mm"]], np.float64,
        ).reshape(-1, 2),
        position_index=index.astype(np.int64),
        position_mm=_points(positions["at_mm"], "positions.at_mm", len(index)),
        position_error=_floats(positions["error"], "positions.error", len(index)),
        position_correlation=_floats(positions["correlation"], "positions.correlation", len(index)),
        excluded={int(one["position"]): str(one["reason"]) for one in content["excluded"]},
    )  # fmt: skip


def _figure(one: dict[str, Any]) -> RecordedFigure:
    passed = one["passed"]
    return RecordedFigure(
        name=str(one["name"]),
        unit=str(one["unit"]),
        definition=str(one["definition"]),
        predicted=_number(one["predicted"]),
        scanned=_number(one["scanned"]),
        difference=_number(one["difference"]),
        value=_number(one["value"]),
        limit=_number(one["limit"]),
        relation=str(one["relation"] or ""),
        passed=None if passed is None else bool(passed),
    )


def _number(value: object) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{value!r} is no number")
    return float(value)


def _floats(values: object, name: str, count: int | None) -> Float64Array:
    if not isinstance(values, list) or (count is not None and len(values) != count):
        raise ValueError(f"{name} is no list of {'numbers' if count is None else f'{count} numbers'}")
    return np.array([math.nan if value is None else float(value) for value in values], np.float64)


def _points(values: object, name: str, count: int | None = None) -> Float64Array:
    points = np.asarray(values, np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not np.isfinite(points).all():
        raise ValueError(f"{name} is no list of points [x, y]")
    if count is not None and len(points) != count:
        raise ValueError(f"{name} has {len(points)} points for {count} positions")
    return points
