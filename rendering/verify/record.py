"""``verify.json``: the record of a verification for programs, and the names of the files in its folder."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from storage.errors import InputError
from storage.output_files import write_whole

if TYPE_CHECKING:
    from rendering.field.focus_figures import FocusInstant
    from rendering.greens.source import GreenSource
    from rendering.scene.model import Scene, Source
    from rendering.verify.verdict import Verification
    from storage.field_file import Field

Float64Array = NDArray[np.float64]

DRIVE_NAME = "drive.h5"
PREDICTION_NAME = "prediction.h5"
SCAN_NAME = "scan.h5"
FIELD_NAMES = (DRIVE_NAME, PREDICTION_NAME, SCAN_NAME)
REPORT_NAME = "report.html"
PICTURE_NAMES = tuple(
    f"{name}.png"
    for name in ("path", "snapshots", "waveforms", "positions", "snr", "error", "gain", "drive", "drift", "waves")
)
RECORD_NAME = "verify.json"
FORMAT = "wavefocus-verification"
VERSION = 1
LOG_NAME = "verify.events.jsonl"
"""Progress, while it works."""
STOP_NAME = "verify.stop"
"""A file of this name ends the verification: outputs muted, mirror parked."""

PATH_POINTS = 401
"""Points of a recorded path: it looks smooth on any screen."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of a verification.

    Of the prediction, of the scan, and between them: None where it has no such side. `value` is what the limit is for,
    None where the positions needed were not scanned. `relation` is "at most" or "at least", empty without a limit;
    `passed` is None where nothing was judged.
    """

    name: str
    unit: str
    definition: str
    predicted: float | None = None
    scanned: float | None = None
    difference: float | None = None
    value: float | None = None
    limit: float | None = None
    relation: str = ""
    passed: bool | None = None


_NUMBERS = ("predicted", "scanned", "difference", "value", "limit")


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSource:
    """Path of a source: evenly along `path_mm`, shape (points, 2), from `start_s` to `stop_s`."""

    start_s: float
    stop_s: float
    path_mm: Float64Array

    def at_mm(self, time_s: float) -> Float64Array | None:
        """Its place, None before it starts; at rest at the end of its path after that."""
        if time_s < self.start_s:
            return None
        times_s = np.linspace(self.start_s, self.stop_s, len(self.path_mm))
        return np.array([np.interp(time_s, times_s, along_mm) for along_mm in self.path_mm.T])


@dataclass(frozen=True, slots=True, eq=False)
class VerificationRecord:
    """The content of ``verify.json``.

    scene, scene_file, bank, rig: Names of what was verified.
    passed: No figure is beyond its limit.
    band_hz: To which both fields were limited.
    figures: Those with a limit first.
    focus_s, float64 (foci,): Focus instants that were compared.
    outline_mm, float64 (points, 2) or None: Rim of the surface.
    actuator_mm, float64 (actuators, 2): NaN where unknown.
    position_index, position_mm, array (positions,) and (positions, 2): Bank rows of the predicted positions, and their
        places.
    position_error, position_correlation, float64 (positions,): NaN where nothing was compared.
    excluded: Scanned bank rows that were not compared, and why.
    """

    path: Path
    made: datetime
    scene: str
    scene_file: str
    bank: str
    rig: str
    passed: bool
    summary: str
    response_unit: str
    band_hz: tuple[float, float] | None
    figures: tuple[Figure, ...]
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
        """Positions that were compared, bool array (positions,)."""
        return np.isfinite(self.position_error)

    @property
    def folder(self) -> Path:
        """Folder of prediction, scan and report."""
        return self.path.parent


def write_record(
    out_dir: Path,
    *,
    verification: Verification,
    scene: Scene,
    prediction: Field,
    bank: GreenSource,
    names: Mapping[str, str],
    outline_mm: NDArray[np.float64] | None = None,
) -> Path:
    """Write ``verify.json`` into the verification's folder; an older one is replaced when the new one is whole.

    `names` are those of scene file, bank and rig on the command line; `outline_mm` is the rim of the surface, closed.
    """
    compared = verification.fields
    rows = np.asarray(prediction.position_index, np.int64)
    position_mm = np.asarray(bank.position_mm, np.float64)
    content = {
        "format": FORMAT,
        "format_version": VERSION,
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "scene": scene.name,
        **names,
        "passed": verification.passed,
        "summary": verification.summary,
        "response_unit": compared.response_unit,
        "band_hz": None if compared.band_hz is None else list(compared.band_hz),
        "spacing_mm": verification.spacing_mm,
        "figures": [_plain_figure(one) for one in verification.figures],
        "foci": [_plain_focus(one, compared.sample_rate_hz, position_mm) for one in compared.instant],
        "sources": [_plain_source(source) for source in scene.sources],
        "outline_mm": None if outline_mm is None else np.round(outline_mm, 3).tolist(),
        "actuator_mm": [
            point.tolist() if np.isfinite(point).all() else None for point in np.asarray(bank.actuator_mm, np.float64)
        ],
        "positions": {
            "index": rows.tolist(),
            "at_mm": position_mm[rows].tolist(),
            "error": _of_rows(rows, compared.position_index, compared.position_error),
            "correlation": _of_rows(rows, compared.position_index, compared.position_correlation),
        },
        "excluded": [{"position": row, "reason": reason} for row, reason in compared.excluded],
    }
    path = out_dir / RECORD_NAME
    write_whole(path, json.dumps(content, allow_nan=False, indent=1) + "\n")
    return path


def finite(value: float | None) -> float | None:
    """None in place of NaN and infinity, which JSON lacks."""
    return value if value is not None and math.isfinite(value) else None


def _plain_figure(figure: Figure) -> dict[str, object]:
    plain = asdict(figure)
    return plain | {name: finite(plain[name]) for name in _NUMBERS} | {"relation": figure.relation or None}


def _plain_focus(focus: FocusInstant, rate_hz: float, position_mm: Float64Array) -> dict[str, object]:
    time_s, at_mm = focus.sample / rate_hz, position_mm[focus.row].tolist()
    return {"source": focus.source, "position": focus.row, "time_s": time_s, "at_mm": at_mm}


def _plain_source(source: Source) -> dict[str, object]:
    length_mm = source.path.length_mm
    moves = length_mm > 0.0 and source.speed_mm_s > 0.0
    stop_s = source.start_s + (length_mm / source.speed_mm_s if moves else 0.0)
    path_mm = path_line_mm(source, PATH_POINTS if moves else 1)
    return {"start_s": source.start_s, "stop_s": stop_s, "path_mm": np.round(path_mm, 3).tolist()}


def path_line_mm(source: Source, points: int) -> Float64Array:
    """So many points evenly along a source's path, its start where it is one."""
    return np.asarray(source.path.point_at(np.linspace(0.0, source.path.length_mm, points)), np.float64)


def _of_rows(rows: NDArray[np.int64], compared: NDArray[np.int64], values: Float64Array) -> list[float | None]:
    by_row = dict(zip(compared.tolist(), values.tolist(), strict=True))
    return [finite(by_row.get(row)) for row in rows.tolist()]


def read_record(path: Path) -> VerificationRecord:
    """Read ``verify.json``; raises InputError where it is missing, damaged or of another format or version."""
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
    try:
        return _record(path, content)
    except (KeyError, TypeError, ValueError, AttributeError) as wrong:
        what = f"{wrong.args[0]} is missing" if isinstance(wrong, KeyError) else str(wrong)
        raise InputError(f"{path} is damaged: {what}; run the verification again") from wrong


def _record(path: Path, content: dict[str, Any]) -> VerificationRecord:
    positions, band, outline_mm = content["positions"], content["band_hz"], content["outline_mm"]
    index = np.asarray(positions["index"])
    if index.ndim != 1 or not len(index) or index.dtype.kind != "i":
        raise ValueError("positions.index is no list of bank rows")
    nowhere = (math.nan, math.nan)
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
        focus_s=_floats([one["time_s"] for one in content["foci"]], "foci"),
        sources=tuple(
            RecordedSource(float(one["start_s"]), float(one["stop_s"]), _points(one["path_mm"], "sources.path_mm"))
            for one in content["sources"]
        ),
        outline_mm=None if outline_mm is None else _points(outline_mm, "outline_mm"),
        actuator_mm=np.array([point or nowhere for point in content["actuator_mm"]], np.float64).reshape(-1, 2),
        position_index=index.astype(np.int64),
        position_mm=_points(positions["at_mm"], "positions.at_mm", len(index)),
        position_error=_floats(positions["error"], "positions.error", len(index)),
        position_correlation=_floats(positions["correlation"], "positions.correlation", len(index)),
        excluded={int(one["position"]): str(one["reason"]) for one in content["excluded"]},
    )


def _figure(one: dict[str, Any]) -> Figure:
    values = {field.name: one[field.name] for field in fields(Figure)}
    for name in _NUMBERS:
        if isinstance(values[name], bool) or not isinstance(values[name], int | float | None):
            raise ValueError(f"{values[name]!r} is no number")
    return Figure(**{**values, "relation": values["relation"] or ""})


def _floats(values: object, name: str, count: int | None = None) -> Float64Array:
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
