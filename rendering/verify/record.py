"""What a verification found, for programs: ``verify.json`` beside the report."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rendering.field.focus_figures import FocusTable, median_or_none
from rendering.report.words import summary
from rendering.verify.names import FORMAT, RECORD_NAME, VERSION
from rendering.verify.verdict import Check, Verification
from storage.output_files import write_whole

if TYPE_CHECKING:
    from rendering.greens.source import GreenSource
    from rendering.scene.model import Scene, Source
    from storage.field_file import Field

# Enough for a path that looks smooth on any screen, and for finding where a source is.
PATH_POINTS = 401
# Checks that belong to both fields together and are no difference of them.
_NO_DIFFERENCE = ("correlation", "usable positions")


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
    """Write ``verify.json``: figures with limits and verdicts, foci, and each position's error.

    Parameters
    ----------
    out_dir : Path
        The verification's folder, which is there.
    verification : Verification
        What `compare` found.
    scene, prediction, bank
        What was rendered, predicted, and with which Green's functions.
    names : mapping of str
        What was verified: scene file, bank, rig, as people named them.
    outline_mm : float64 array, shape (points, 2), optional
        Rim of the surface, closed.

    Returns
    -------
    Path
        The file; an older one is replaced when the new one is whole.

    Raises
    ------
    InputError
        It cannot be written.
    """
    fields = verification.fields
    rows = np.asarray(prediction.position_index, np.int64)
    position_mm = np.asarray(bank.position_mm, np.float64)
    content = {
        "format": FORMAT,
        "format_version": VERSION,
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "scene": scene.name,
        **names,
        "passed": verification.passed,
        "summary": summary(verification),
        "response_unit": fields.response_unit,
        "band_hz": None if fields.band_hz is None else list(fields.band_hz),
        "spacing_mm": verification.spacing_mm,
        "figures": _figures(verification),
        "foci": [
            {
                "source": one.source,
                "position": one.row,
                "time_s": one.sample / fields.sample_rate_hz,
                "at_mm": position_mm[one.row].tolist(),
            }
            for one in fields.instant
        ],
        "sources": [_source(source) for source in scene.sources],
        "outline_mm": None if outline_mm is None else np.round(outline_mm, 3).tolist(),
        "actuator_mm": [_plain(point) for point in np.asarray(bank.actuator_mm, np.float64)],
        "positions": {
            "index": rows.tolist(),
            "at_mm": position_mm[rows].tolist(),
            "error": _of_rows(rows, fields.position_index, fields.position_error),
            "correlation": _of_rows(rows, fields.position_index, fields.position_correlation),
        },
        "excluded": [{"position": row, "reason": reason} for row, reason in fields.excluded],
    }
    path = out_dir / RECORD_NAME
    write_whole(path, json.dumps(content, allow_nan=False, indent=1) + "\n")
    return path


def _figures(verification: Verification) -> list[dict[str, object]]:
    """Those with a limit, then those without one; predicted and scanned where a figure has two sides."""
    sides = _sides(verification)
    listed = []
    for check in verification.checks:
        alone = None if check.name in _NO_DIFFERENCE else check.value
        predicted, scanned, difference = sides.get(check.name, (None, None, alone))
        listed.append(_figure(check.name, predicted, scanned, difference, check.unit, check.definition, check))
    fields, focus = verification.fields, verification.focus
    told: tuple[tuple[str, float | None, float | None, str, str], ...] = (
        ("level", fields.level_db, None, "dB",
         "gain that fits the prediction best to the scan, above 0 where the scan is louder"),
        ("delay", 1e6 * fields.delay_samples / fields.sample_rate_hz, None, "µs",
         "how much later the scan is: peak of the cross-correlation summed over positions"),
        ("median correlation", None, fields.correlation_median, "",
         "median over positions of the correlation at each"),
        ("error from noise alone", None, _percent(verification.noise_error), "%",
         "what the vibrometer's noise makes of the normalised error"),
        ("error, all frequencies", _percent(fields.error_all_frequencies), None, "%",
         "the normalised error without limiting both fields to the bank's band"),
    )  # fmt: skip
    for name, difference, value, unit, definition in told:
        listed.append(_figure(name, None, None, difference, unit, definition, value=value))
    artefacts_db = median_or_none(focus.scanned_artefact_db)
    artefacts = "median over focus instants of the largest magnitude beyond 15 mm from the path point over that within"
    listed.append(_figure("artefacts", None, artefacts_db, None, "dB", artefacts))
    return listed


def _sides(verification: Verification) -> dict[str, tuple[float | None, float | None, float | None]]:
    """Predicted, scanned and difference of the figures that both fields have."""
    focus = verification.focus
    to_path = _predicted_from_intended_mm(focus), median_or_none(focus.from_intended_mm)
    return {
        "focus to path point": (*to_path, None if None in to_path else _minus(to_path[1], to_path[0])),
        "focal width against prediction": (
            median_or_none(focus.predicted_width_mm),
            median_or_none(focus.scanned_width_mm),
            median_or_none(np.abs(focus.width_difference_mm)),
        ),
    }


def _predicted_from_intended_mm(focus: FocusTable) -> float | None:
    return median_or_none(np.asarray(np.hypot(*(focus.predicted_mm - focus.intended_mm).T)))


def _minus(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None else one - other


def _figure(
    name: str,
    predicted: float | None,
    scanned: float | None,
    difference: float | None,
    unit: str,
    definition: str,
    check: Check | None = None,
    value: float | None = None,
) -> dict[str, object]:
    """One figure; its value is what is held against the limit, or would be."""
    if check is not None:
        value = check.value
    elif value is None:
        value = scanned if difference is None else difference
    limit = None if check is None else _finite(check.limit)
    return {
        "name": name,
        "predicted": _finite(predicted),
        "scanned": _finite(scanned),
        "difference": _finite(difference),
        "value": _finite(value),
        "unit": unit,
        "limit": limit,
        "relation": None if check is None else check.relation,
        "passed": None if check is None else check.passed,
        "definition": definition,
    }


def _source(source: Source) -> dict[str, object]:
    """Where a source is and when: evenly along its path, at even times."""
    length_mm = source.path.length_mm
    moves = length_mm > 0.0 and source.speed_mm_s > 0.0
    arc_mm = np.linspace(0.0, length_mm, PATH_POINTS if moves else 1)
    return {
        "start_s": source.start_s,
        "stop_s": source.start_s + (length_mm / source.speed_mm_s if moves else 0.0),
        "path_mm": np.round(np.asarray(source.path.point_at(arc_mm), np.float64), 3).tolist(),
    }


def _of_rows(rows: NDArray[np.int64], compared: NDArray[np.int64], values: NDArray[np.float64]) -> list[float | None]:
    by_row = dict(zip(compared.tolist(), values.tolist(), strict=True))
    return [_finite(by_row.get(row)) for row in rows.tolist()]


def _plain(point: NDArray[np.float64]) -> list[float] | None:
    return point.tolist() if np.isfinite(point).all() else None


def _percent(value: float | None) -> float | None:
    return None if value is None else 100.0 * value


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
