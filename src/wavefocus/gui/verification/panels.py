"""What a verification has left: its files, maps and figures."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PyQt5.QtWidgets import QWidget

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.gui import widgets as ui
from wavefocus.gui.field_map import Real
from wavefocus.gui.film_player import Film, FilmPlayer, Frame
from wavefocus.gui.surface import PlotSurface, raster_of
from wavefocus.gui.surface_view import NOWHERE_MM
from wavefocus.gui.theme import Themed
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.verify.record import PREDICTION_NAME, REPORT_NAME, SCAN_NAME
from wavefocus.storage.errors import InputError, WavefocusError

if TYPE_CHECKING:
    from wavefocus.rendering.verify.field_pair import FieldPair
    from wavefocus.rendering.verify.record import VerificationRecord
    from wavefocus.rendering.verify.results import Figure


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """One verification: its folder and record, and the film of prediction, scan and difference."""

    folder: Path
    record: VerificationRecord
    film: Film


def read_results(record_file: Path, wanted: Callable[[], bool]) -> Results:
    """Read a verification; takes a second for some hundred megabytes.

    Raises InputError: A file is missing, damaged or of another verification; the message names it. Raises
    CancelledError: `wanted` returned False.
    """
    from wavefocus.rendering.verify.field_pair import read_pair  # the window starts without scipy
    from wavefocus.rendering.verify.record import read_record

    record = read_record(record_file)
    folder = record_file.parent
    pair = read_pair(folder / PREDICTION_NAME, folder / SCAN_NAME, record.band_hz, wanted)
    if not np.array_equal(pair.position_index, record.position_index):
        raise InputError(
            f"{folder / PREDICTION_NAME} has other positions than {record_file}; run the verification again"
        )
    return Results(folder, record, _film_of(record, pair))


def _film_of(record: VerificationRecord, pair: FieldPair) -> Film:
    def frames(sample: int) -> list[Frame]:
        predicted, scanned = np.array(pair.fields[:, :, sample])
        return [predicted, scanned, np.where(record.compared, scanned - predicted, np.nan)]

    def response(place: int) -> tuple[str, list[Real]]:
        (x_mm, y_mm), (predicted, scanned) = record.position_mm[place], np.array(pair.fields[:, place])
        title = f"position {record.position_index[place]} at ({x_mm:.1f}, {y_mm:.1f}) mm"
        return f"{title}: {_figures_text(record, place)}", [predicted, scanned, scanned - predicted]

    focus = np.array([pair.sample_at(time_s) for time_s in record.focus_s], np.int64)
    loudest, difference = pair.loudest(focus if len(focus) else evenly_spread(pair.samples, 64), record.compared)
    checks = _check_places(record)
    surface = PlotSurface(
        record.position_mm, record.actuator_places_mm,
        None if record.outline_mm is None else np.array(record.outline_mm),
        raster_of(record.position_mm, checks, gaps=False), [np.array(source.path_mm) for source in record.sources],
        checks,
    )  # fmt: skip
    scales = [
        ("prediction, both on one scale", loudest),
        ("scan, both on one scale", loudest),
        ("scan − prediction, own scale", difference),
    ]
    return Film(
        surface, pair.start_s, pair.sample_rate_hz, pair.samples, frames, partial(_sources_mm, record), focus, response,
        pair.response_unit, scales,
    )  # fmt: skip


def _sources_mm(record: VerificationRecord, time_s: float) -> Float64Array:
    places = [source.at_mm(time_s) for source in record.sources]
    return np.array([place for place in places if place is not None], np.float64).reshape(-1, 2)


def _check_places(record: VerificationRecord) -> NDArray[np.intp]:
    """Which positions of a verification lie off its bank's grid; none where the bank is not there any more."""
    from wavefocus.storage.bank.reading import open_bank

    with suppress(WavefocusError, OSError), open_bank(Path(record.bank)) as bank:
        return np.flatnonzero(np.isin(record.position_index, bank.check_rows))
    return np.zeros(0, np.intp)


_COLUMNS = ("Figure", "Predicted", "Scanned", "Between", "Tolerance", "Verdict")
# Signs differ, too, not only colours.
_VERDICTS = {True: "✓ pass", False: "✗ fail", None: "– not judged"}


class VerdictPanel(Themed, QWidget):
    """Verdict, and below it in its colour what is beyond a limit and what is wrong, with what to do."""

    def __init__(self) -> None:
        super().__init__()
        self.verdict = ui.Badge("Verdict")
        self.summary = ui.label("Summary", any_width=True)
        self.findings = ui.label("Findings", role="fault", wraps=True, selectable=True)
        ui.column(ui.row(self.verdict, (self.summary, 1), spacing=8), self.findings, owner=self, spacing=2)

    def show_results(self, results: Results) -> None:
        record, theme = results.record, self.theme
        word, colour = ("✓ passed", theme.good) if record.passed else ("✗ not good enough", theme.fault)
        self.verdict.show_word(word, colour)
        made = "" if record.made is None else record.made.astimezone().strftime("%d %b %Y %H:%M")
        self.summary.setText(f"{record.scene}, {made}, in {results.folder.name}: {record.summary}")
        self.summary.setToolTip(
            f"{record.summary}\nscene {record.scene_file}\nbank {record.bank}\nrig {record.rig}\n{results.folder}"
        )
        lines = _findings(record)
        self.findings.setText("\n".join(lines))
        self.findings.setVisible(bool(lines))


class FiguresPanel(Themed, QWidget):
    """Table of the figures, buttons; `opens` receives the name of a file, empty for the folder."""

    def __init__(self, opens: Callable[[str], object]) -> None:
        super().__init__()
        self.table = ui.table(_COLUMNS, "Figures with tolerances", (0,))
        self.table.setShowGrid(False)
        tip = "The HTML report with all pictures, in the browser"
        self.report = ui.tool_button("Open report", tip, partial(opens, REPORT_NAME))
        tip = "The folder of drive, prediction, scan, report and verify.json"
        folder = ui.tool_button("Open folder", tip, partial(opens, ""))
        ui.column((self.table, 1), ui.row(self.report, folder, None), owner=self, spacing=4)

    def show_results(self, results: Results) -> None:
        figures, theme = results.record.figures, self.theme
        colours = {True: theme.good, False: theme.fault, None: theme.faint}
        last = len(_COLUMNS) - 1
        self.table.setRowCount(len(figures))
        for number, figure in enumerate(figures):
            tip = f"{figure.name}: {figure.definition}"
            ui.fill_row(
                self.table, number, _cells(figure), {last: colours[figure.passed]}, right=range(1, last), tip=tip
            )


def _cells(figure: Figure) -> list[str]:
    from wavefocus.rendering.number_text import number, precise  # the window starts without scipy

    shown = precise if "correlation" in figure.name else lambda value: number(value, figure.unit)
    between = figure.difference
    if between is None and figure.scanned is None:
        between = figure.value
    sides = ["" if value is None else shown(value) for value in (figure.predicted, figure.scanned, between)]
    if figure.limit is None:
        return [figure.name, *sides, "", ""]
    sign = "≤" if figure.relation == "at most" else "≥"
    return [figure.name, *sides, f"{sign} {number(figure.limit, figure.unit)}", _VERDICTS[figure.passed]]


def _findings(record: VerificationRecord) -> list[str]:
    """Figures beyond their limits, and symptoms with what to do."""
    from wavefocus.rendering.number_text import number
    from wavefocus.rendering.verify.results import remedy, sentence

    beyond = [
        f"▲ {one.name}: {number(one.value, one.unit)}, {one.relation} {number(one.limit, one.unit)} is allowed"
        for one in record.figures
        if one.passed is False and one.value is not None and one.limit is not None
    ]
    return [*beyond, *(f"▲ {sentence(symptom)} {remedy(symptom)}" for symptom in record.symptoms)]


def _figures_text(record: VerificationRecord, index: int) -> str:
    """The figures of a position, or why it has none."""
    row = int(record.position_index[index])
    if excluded := [one.reason for one in record.excluded if one.position == row]:
        return f"not compared: {excluded[0]}"
    error, correlation = record.position_error[index], record.position_correlation[index]
    if math.isnan(error):
        return "silent, or not scanned"
    return f"error {100 * error:.3g} %, correlation {correlation:.5f}"


# Names, and the number of the colour and width: where prediction and scan agree, the scan lies inside the wider line.
_LINES = {"prediction": (0, 3.0), "scan": (1, 1.2), "difference": (3, 1.0)}


class MapsPanel(FilmPlayer):
    """Prediction, scan and their difference."""

    def __init__(self) -> None:
        super().__init__(("Prediction", "Scan", "Difference"), list(_LINES.values()))
        for field_map in self.maps:
            field_map.setMinimumSize(150, 110)
        columns = [(ui.column((one, 1), one.bar, spacing=2), 1) for one in self.maps]
        ui.column((ui.row(*columns, spacing=6), 1), self.time, owner=self)
        lines = (
            f'<span style="color:{self.theme.trace(colour)}">━ {name}</span>' for name, (colour, _) in _LINES.items()
        )
        self.legend = ui.label("Legend of the lines", "   ".join(lines))

    def show_results(self, results: Results) -> None:
        """Show another verification, at its first focus instant."""
        self.show_film(film := results.film)
        first_mm = film.sources_mm(results.record.focus_s[0]) if len(film.marks) else NOWHERE_MM
        if self.marked < 0 and len(first_mm):  # so that a response is seen at once
            self.show_position(film.surface.raster.nearest(*first_mm[0].tolist()))
