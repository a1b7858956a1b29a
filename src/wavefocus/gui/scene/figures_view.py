"""The figures of a scene with verdicts and definitions."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from PyQt5.QtWidgets import QTableWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.scene.calculation import SceneResults
from wavefocus.gui.theme import Themed
from wavefocus.storage.units import quantity

# Verdicts.
GOOD, HELD, MISSED = "within", "held back", "not reached"


@dataclass(frozen=True, slots=True)
class SceneMetric:
    """One line of the table; the verdict is empty where nothing was asked for."""

    name: str
    value: str
    definition: str
    verdict: str = ""


def figures_of(results: SceneResults) -> list[SceneMetric]:
    """The figures that ``render --json`` prints, and medians over the foci."""
    facts: dict[str, Any] = results.facts
    drive, foci, unit = results.drive, results.figures, facts["response_unit"]
    limited = facts["limited_by"]
    metrics = [
        SceneMetric(
            "scale by the limits", f"{facts['scale']:.3g}" + (f", for {limited}" if limited else ""),
            "Factor on all drives that keeps every actuator within its limits: drives are scaled, never clipped",
            HELD if limited else GOOD,
        ),
        SceneMetric("peak of the drives", quantity(f"{facts['peak_v']:.3g}", drive.drive_unit), "Of any actuator"),
        SceneMetric(
            "dynamic range", f"{facts['dynamic_range_db']:.1f} dB",
            "Largest over smallest rms of all actuators that are driven at all; saturation makes it smaller",
        ),
        SceneMetric(
            "duration", f"{drive.drive_v.shape[1] / drive.sample_rate_hz:.3f} s", "With the lead-in of time reversal"
        ),
    ]  # fmt: skip
    metrics += [
        SceneMetric(
            f"level at {one['name']}", f"{one['reached_db']:.1f} dB of {one['level_db']:g} dB",
            "Energy of the response there over that at the loudest focus; less where output.most_energy does not do",
            MISSED if one["missed"] else GOOD,
        )
        for one in facts.get("quiet", ())
    ]  # fmt: skip
    if foci is not None:
        for name, values, of, definition in (
            ("response at the foci", np.abs(foci.peak), unit, "Largest predicted response near the path point"),
            ("focal width", foci.width_mm, "mm", "Full width at half maximum of the focal spot"),
            ("focus position error", foci.off_mm, "mm", "Distance of the largest response from the path point"),
            ("artefact level", foci.artefact_db, "dB", "Largest response beyond 15 mm over the largest within"),
        ):
            known = values[np.isfinite(values)]
            median = float(np.median(known)) if len(known) else math.nan
            value = "—" if math.isnan(median) else quantity(f"{median:.3g}", of)
            metrics.append(SceneMetric(name, value, f"{definition}; median of {len(foci)} foci"))
    return metrics


def figures_table() -> QTableWidget:
    """An empty table of figures."""
    return ui.table(("figure", "value", "verdict"), "Figures of the scene", (0,))


def fill_figures(table: QTableWidget, results: SceneResults | None) -> None:
    """Show the figures of a scene, or none; definitions are in the tooltips."""
    figures = [] if results is None else figures_of(results)
    table.setRowCount(len(figures))
    for number, one in enumerate(figures):
        colours = {2: Themed.theme.warning if one.verdict in (HELD, MISSED) else Themed.theme.good}
        ui.fill_row(table, number, (one.name, one.value, one.verdict), colours, right=(1,), tip=one.definition)
