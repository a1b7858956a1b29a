"""The figures of a scene with units, limits, verdicts and definitions, and the warnings below them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from PyQt5.QtWidgets import QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.scene.calculation import DriveResult, FocusFigures, PredictedField
from wavefocus.gui.theme import Themed
from wavefocus.rendering.arrays import Float64Array
from wavefocus.storage.units import quantity

# Verdicts.
GOOD, HELD, MISSED = "within", "held back", "not reached"


@dataclass(frozen=True, slots=True)
class SceneMetric:
    """One line of the table; the value is empty where unknown, the limit where there is none.

    The verdict is `GOOD`, `HELD` where all drives were scaled down for it, `MISSED` where a level is not reached, or
    empty.
    """

    name: str
    value: str
    unit: str
    definition: str
    limit: str = ""
    verdict: str = ""


def drive_figures(driven: DriveResult) -> list[SceneMetric]:
    """Return the figures of the drives."""
    from wavefocus.rendering.drive.coil_limits import (  # loaded by then, by another thread
        RMS_WINDOW_S,
        dynamic_range_db,
    )
    from wavefocus.rendering.field.metrics import range_db

    limiting, limits = driven.limiting, driven.limits
    decided = limiting.decided_by
    loudest, hottest = int(np.argmax(driven.peak_v)), int(np.argmax(driven.rms_v))
    peak_v, rms_v = float(driven.peak_v[loudest]), float(driven.rms_v[hottest])
    figures = [
        SceneMetric(
            "scale by the limits", _short(limiting.scale), "",
            "Factor on all drives that keeps every actuator within its limits; 1 where nothing exceeds them. Drives are"
            f" scaled, never clipped, and so the responses shrink with them. Now: {limiting}.",
            verdict=HELD if decided else GOOD,
        ),
        SceneMetric(
            "peak of the drives", _short(peak_v), driven.unit,
            f"Largest magnitude of any actuator's drive after scaling; actuator {loudest} has it. Its limit is"
            f" {limits.peak_key}.",
            _limit(limits.peak_v, driven.unit), _verdict(limits.peak_v, decided == limits.peak_key),
        ),
        SceneMetric(
            "rms of the drives", _short(rms_v), driven.unit,
            f"Largest rms of any actuator's drive over any {RMS_WINDOW_S:g} s, or over all of a shorter one, after"
            f" scaling; actuator {hottest} has it. Its limit is {limits.rms_key}.",
            _limit(limits.rms_v, driven.unit), _verdict(limits.rms_v, decided == limits.rms_key),
        ),
    ]  # fmt: skip
    if driven.resistance_ohm:
        power = None if limits.rms_v is None else limits.rms_v**2 / driven.resistance_ohm
        figures.append(SceneMetric(
            "coil power", _short(rms_v**2 / driven.resistance_ohm), "W",
            f"rms² over the coil's resistance of {driven.resistance_ohm:g} ohms, by the rig file.",
            _limit(power, "W"), _verdict(power, decided == limits.rms_key),
        ))  # fmt: skip
    gain_db = range_db(driven.gain)
    figures += [
        SceneMetric(
            "dynamic range", f"{dynamic_range_db(np.linalg.norm(driven.drive_v, axis=1)):.1f}", "dB",
            "Largest over smallest rms, over the whole drive, of all actuators that are driven at all. Saturation"
            " makes it smaller.",
        ),
        SceneMetric(
            "range of n(x)", "" if math.isnan(gain_db) else f"{gain_db:.1f}", "dB",
            "Largest over smallest n(x) of eq. (15) along the paths: how unequally well the surface can be focused on.",
        ),
        SceneMetric(
            "left out", "" if math.isnan(driven.omitted_bound) else f"{driven.omitted_bound:.2g}", "",
            "Proved bound on the relative L2 error of the drives from what is left out while you edit (-60 dB). What is"
            " saved and played leaves nothing out.",
        ),
        SceneMetric(
            "duration", f"{driven.lasts_s:.3f}", "s",
            "Of the drives, with the lead-in that time reversal needs: one Green's function's length.",
        ),
        SceneMetric(
            "method", driven.method, "",
            "exact: a continuous source moves from sample to sample (eq. 9); sampled: from path point to path point"
            " (eq. 16). Emission per point is sampled by nature.",
        ),
        SceneMetric(
            "largest snap", f"{driven.snap_mm:.2f}", "mm",
            "Largest distance of a path point from the bank's position nearest to it.",
        ),
    ]  # fmt: skip
    figures += [
        SceneMetric(
            f"level at {one.name}", one.text, "dB",
            "Energy of the response there over that at the loudest focus, by the bank; of a source, that of the other"
            " sources. Less is reached where it would cost more than output.most_energy.",
            f"{one.asked_db:g} dB", GOOD if one.reached_db <= one.asked_db + 0.5 else MISSED,
        )
        for one in driven.levels
    ]  # fmt: skip
    return figures


def field_figures(found: FocusFigures, field: PredictedField) -> list[SceneMetric]:
    """Return the figures of the foci."""
    from wavefocus.rendering.field.focus_figures import FOCUS_RADIUS_MM

    radius = f"{FOCUS_RADIUS_MM:g} mm"
    return [
        SceneMetric(
            "response at the foci", _of(found.peak, _short), field.unit,
            f"Largest predicted response within {radius} of the path point, at the instant when it is loudest; median"
            f" of {len(found.time_s)} foci, evenly chosen.",
        ),
        SceneMetric(
            "focal width", _of(found.width_mm, lambda value: f"{value:.1f}"), "mm",
            "Full width at half maximum of the focal spot: diameter of the disk of equal area; median of the foci that"
            " lie wholly on measured positions.",
        ),
        SceneMetric(
            "focus position error", _of(found.off_mm, lambda value: f"{value:.2f}"), "mm",
            f"Distance of the largest response within {radius} from the path point on the grid; median.",
        ),
        SceneMetric(
            "artefact level", _of(found.artefact_db, lambda value: f"{value:.1f}"), "dB",
            f"Largest response further than {radius} from the focus over the largest within; median.",
        ),
        *(
            SceneMetric(
                f"crosstalk of source {source}", f"{100 * ratio:.1f}", "%",
                "Amplitude of the response at a focus to all other foci of the path, in the middle of its"
                " emission, over that of its own; over at most 24 path points in the middle of the path.",
            )
            for source, ratio in found.crosstalk
        ),
    ]  # fmt: skip


def _of(values: Float64Array, words: Callable[[float], str]) -> str:
    from wavefocus.rendering.field.focus_figures import median_or_none

    median = median_or_none(values)
    return "" if median is None else words(median)


def _short(value: float) -> str:
    return f"{value:.3g}"


def _limit(limit: float | None, unit: str) -> str:
    return "" if limit is None else f"{limit:.3g} {unit}"


def _verdict(limit: float | None, decided: bool) -> str:
    if limit is None:
        return ""
    return HELD if decided else GOOD


class FiguresView(Themed, QWidget):
    """The table of figures; definitions are in the tooltips."""

    def __init__(self) -> None:
        super().__init__()
        self.figures: Sequence[SceneMetric] = ()
        self.table = ui.table(("figure", "value", "limit", "verdict"), "Figures of the scene", (0,))
        self.warnings = ui.label("Warnings of the scene", wraps=True, selectable=True)
        self.warnings.setContentsMargins(6, 4, 6, 4)
        ui.column((self.table, 1), self.warnings, owner=self)
        self.show_figures((), ())

    def show_figures(self, figures: Sequence[SceneMetric], warnings: Sequence[str]) -> None:
        self.figures = figures
        self.warnings.setText("\n".join(f"• {warning}" for warning in warnings))
        self.warnings.setVisible(bool(warnings))
        self.redraw()

    def redraw(self) -> None:
        self.table.setRowCount(len(self.figures))
        for number, one in enumerate(self.figures):
            texts = (one.name, quantity(one.value, one.unit) if one.value else "—", one.limit, one.verdict)
            colours = {3: self.theme.warning if one.verdict in (HELD, MISSED) else self.theme.good}
            ui.fill_row(self.table, number, texts, colours, right=(1, 2), tip=one.definition)
