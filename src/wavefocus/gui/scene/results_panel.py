"""Drives, field and figures of a scene, calculated while it is edited, with the buttons that save and play it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PyQt5.QtWidgets import QTableWidget, QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.field_map import Plot, Real
from wavefocus.gui.files import choose_place, names_virtual_rig
from wavefocus.gui.film_player import Film, FilmPlayer
from wavefocus.gui.scene.calculation import Calculation, SceneResults
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.scene.exports import IDLE, KINDS, PLAYING, STOPPING, Output
from wavefocus.gui.surface import PlotSurface, surface_of
from wavefocus.gui.surface_view import NOWHERE_MM
from wavefocus.gui.tab import TabContext
from wavefocus.gui.theme import Themed
from wavefocus.rendering.arrays import Float64Array
from wavefocus.storage.errors import InputError
from wavefocus.storage.units import quantity

if TYPE_CHECKING:
    from wavefocus.storage.field_file import Field

_STEP = 0.45  # the loudest trace fills so much of the distance to its neighbours, up and down


class _DrivesView(Plot):
    """Drives of all actuators over time."""

    def __init__(self) -> None:
        super().__init__("Drives of all actuators", "time (s)", "actuator", axis_px=58)
        self.getPlotItem().setClipToView(True)

    def show_results(self, results: SceneResults | None) -> None:
        """Show drives, or none."""
        if results is None:
            self.getPlotItem().clear()
            self.title("no drives to show", faint=True, size="9pt")
            return
        drive = results.drive
        time_s = drive.start_s + np.arange(drive.drive_v.shape[1]) / drive.sample_rate_hz
        largest = self.stack(time_s, drive.drive_v, _STEP)
        self.title(f"a step is {quantity(f'{largest / _STEP:.3g}', drive.drive_unit)}", size="9pt")


class _FieldView(FilmPlayer):
    """Plays the scene's predicted field, or that of a file, with the response of a position."""

    def __init__(self) -> None:
        super().__init__(["response"], [(0, 1.0)])
        self.results: SceneResults | None = None
        self.file: Path | None = None
        self._seen = False  # whether the instants of a scene's foci have been shown
        self.map, self.slider = self.maps[0], self.time
        self.name = ui.label("Field file shown", any_width=True)
        self.close_file = ui.tool_button("Close file", "Show the field of the scene again", self._close_file)
        self._file_row = QWidget()
        ui.row((self.name, 1), self.close_file, owner=self._file_row, margins=(4, 2, 4, 0))
        self._file_row.hide()
        upper = QWidget()
        speed = ui.row(self.slider.slower, None, margins=(4, 4, 4, 0))  # the slider's own row is as wide as the panel
        ui.column(self._file_row, speed, (self.map, 1), self.map.bar, self.slider, owner=upper, spacing=3)
        ui.column(ui.side_by_side((upper, 420), (self.response, 130), growing=[0], above=True), owner=self)

    def show_results(self, results: SceneResults | None) -> None:
        """Show another field of the scene, at the same instant and position; None shows none."""
        self.results = results
        if self.file is None:
            self._show_scene()

    def show_file(self, path: Path, field: Field, surface: PlotSurface) -> None:
        """Show the field of a file until it is closed; `surface` has its positions."""
        self.file, self._seen = path, False
        self.name.setText(f"{path.name}: {len(field.field)} positions, {field.sample_rate_hz:g} Hz")
        self.name.setToolTip(str(path))
        self._file_row.show()
        self._show_field(field, surface, np.zeros(0), lambda _time_s: NOWHERE_MM)

    def _show_scene(self) -> None:
        results = self.results
        if results is None or results.field is None:
            self._seen = False
            self.show_film(None)
            return
        foci, surface, index = results.foci, results.surface, results.field.position_index
        marks_s = np.zeros(0) if results.figures is None else results.figures.time_s
        self._show_field(
            results.field, surface, marks_s, lambda time_s: surface.position_mm[np.isin(index, foci.at(time_s))]
        )

    def _close_file(self) -> None:
        self.file = None
        self._file_row.hide()
        self._show_scene()

    def _show_field(
        self,
        field: Field,
        surface: PlotSurface,
        marks_s: Float64Array,
        sources_mm: Callable[[float], Float64Array],
    ) -> None:
        def response(place: int) -> tuple[str, list[Real]]:
            x_mm, y_mm = surface.position_mm[place]
            return f"position {field.position_index[place]} at ({x_mm:.1f}, {y_mm:.1f}) mm", [field.field[place]]

        at_s = self.slider.time_s
        marks = np.rint((marks_s - field.start_s) * field.sample_rate_hz).astype(np.int64)
        self.show_film(
            Film(
                surface, field.start_s, field.sample_rate_hz, field.field.shape[1],
                lambda sample: [field.field[:, sample]], sources_mm, marks, response, field.response_unit,
                [("response", float(max(field.field.max(), -field.field.min())))],
            )
        )  # fmt: skip
        if self._seen and at_s >= field.start_s:
            self.slider.go_to(round((at_s - field.start_s) * field.sample_rate_hz))
        self._seen |= len(marks) > 0


def read_field_on(path: Path, bank: Path) -> tuple[Field, PlotSurface]:
    """Read a field file, and the places of its positions from a bank.

    Raises InputError: One of both cannot be read, or the field has positions that the bank has not.
    """
    from wavefocus.storage.bank.reading import open_bank
    from wavefocus.storage.field_file import read_field

    field = read_field(path)
    with open_bank(bank) as view:
        last = int(field.position_index.max())
        if last >= view.positions:
            raise InputError(
                f"{path} has a position {last}, and {bank} has {view.positions} positions: choose the bank that the"
                " field belongs to"
            )
        return field, surface_of(view).with_rows(field.position_index)


# Verdicts.
GOOD, HELD, MISSED = "within", "held back", "not reached"


def figures_of(results: SceneResults) -> list[tuple[str, str, str, str]]:
    """Name, value, verdict (empty where nothing was asked for) and definition of what ``render`` and the foci say."""
    facts: dict[str, Any] = results.facts
    drive, foci, unit, limited = results.drive, results.figures, facts["response_unit"], facts["limited_by"]
    metrics = [
        ("scale by the limits", f"{facts['scale']:.3g}" + (f", for {limited}" if limited else ""),
         HELD if limited else GOOD,
         "Factor on all drives that keeps every actuator within its limits: drives are scaled, never clipped"),
        ("peak of the drives", quantity(f"{facts['peak_v']:.3g}", drive.drive_unit), "", "Of any actuator"),
        ("dynamic range", f"{facts['dynamic_range_db']:.1f} dB", "",
         "Largest over smallest rms of all actuators that are driven at all; saturation makes it smaller"),
        ("duration", f"{drive.drive_v.shape[1] / drive.sample_rate_hz:.3f} s", "", "With the lead-in of time reversal"),
    ]  # fmt: skip
    about = "Energy of the response there over that at the loudest focus; less where output.most_energy does not do"
    metrics += [
        (f"level at {one['name']}", f"{one['reached_db']:.1f} dB of {one['level_db']:g} dB",
         MISSED if one["missed"] else GOOD, about)
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
            value = quantity(f"{np.median(known):.3g}", of) if len(known) else "—"
            metrics.append((name, value, "", f"{definition}; median of {len(foci)} foci"))
    return metrics


def _fill_figures(table: QTableWidget, results: SceneResults | None) -> None:
    """Show the figures of a scene, or none; definitions are in the tooltips."""
    figures = [] if results is None else figures_of(results)
    table.setRowCount(len(figures))
    for number, (name, value, verdict, definition) in enumerate(figures):
        colours = {2: Themed.theme.warning if verdict in (HELD, MISSED) else Themed.theme.good}
        ui.fill_row(table, number, (name, value, verdict), colours, right=(1,), tip=definition)


class ResultsPanel(Themed, QWidget):
    """Results of the present scene, its warnings above them."""

    def __init__(self, context: TabContext, document: SceneDocument) -> None:
        super().__init__()
        self.setAccessibleName("Results of the scene")
        self._context, self._document = context, document
        self.calculation = Calculation(context, document)
        self.output = Output(context, document)
        self._shown: SceneResults | None = None
        self.drives, self.field = _DrivesView(), _FieldView()
        self.figures = ui.table(("figure", "value", "verdict"), "Figures of the scene", (0,))
        self.stage = ui.label("Stage of the calculation", any_width=True)
        self.problem = ui.label("Problem of the calculation", wraps=True)
        self.problem.setMinimumWidth(1)
        self.warnings = ui.label("Warnings of the scene", role="warning", wraps=True, selectable=True)
        self.warnings.setMinimumWidth(1)
        self._warned = ui.scrolling(self.warnings)
        self._warned.setMaximumHeight(4 * self.warnings.fontMetrics().lineSpacing())
        self._warned.hide()
        self.pages = ui.tab_pages("Results", {"Drives": self.drives, "Field": self.field, "Figures": self.figures})
        foot = self._make_controls()
        ui.column(self.stage, self.problem, self._warned, (self.pages, 1), *foot, owner=self, spacing=3)
        for changed in (self.output.changed, document.rig_changed):
            changed.connect(self._show_state)
        self.calculation.changed.connect(self._show)
        self._show_state()

    def _make_controls(self) -> list[ui.Item]:
        tip = "Softer (negative) or louder than saved (dB); the rig's limits hold"
        self.gain = ui.number_box("Gain in dB", tip, " dB", 1, -60.0, 60.0, prefix="gain ")
        tip = "Number of repetitions, without a gap"
        self.loops = ui.number_box("Repetitions", tip, "", 0, 1.0, 10_000.0, value=1.0, prefix="× ")
        self._state = ui.label("Saving and playing", role="faint", any_width=True)
        tip = "Render the scene exactly and save the drives (V), or the sound file of the rig's interface (.wav)"
        self.actions_by_name = {
            "drive": ui.action(self, "Save &drive…", self._choose_place, "Ctrl+E", tip=tip),
            "play": ui.action(self, "&Play", self.play, "F9", tip="Render within the rig's limits and play"),
            "stop": ui.action(self, "&Stop", self.output.stop, "Shift+F9", tip="Stop at once and mute the outputs"),
        }
        self.buttons = {name: ui.button(action) for name, action in self.actions_by_name.items()}
        saves, plays, stops = self.buttons.values()
        stops.setStyleSheet(f"QToolButton:enabled {{ color: {self.theme.warning}; font-weight: 600; }}")
        return [ui.row(saves, None), ui.row(self.gain, self.loops, plays, stops, None), self._state]

    def poll(self) -> None:
        """Calculate what is shown, and show what is played."""
        if self.output.state == PLAYING:  # its time goes on
            self._show_state()
        # No new results end a film that plays.
        self.calculation.poll(shown=self.isVisible(), look=not self.field.slider.playing)

    def play(self) -> None:
        """Play the present scene on the rig."""
        drive = None if self.calculation.results is None else self.calculation.results.drive
        lasts_s = 0.0 if drive is None else drive.drive_v.shape[1] / drive.sample_rate_hz
        act = partial(self.output.play, self.gain.value(), self.loops.whole(), lasts_s)
        self._context.claim_instruments("Play", act, virtual=names_virtual_rig(self._document.rig))

    def _choose_place(self) -> None:
        choose_place(self, "Save the drives", self.output.suggested, KINDS, self.output.save)

    def _show(self) -> None:
        """Show what the calculation has, and what it does."""
        calculation, results = self.calculation, self.calculation.results
        if results is None or results is not self._shown:
            self._shown = results
            self.drives.show_results(results)
            _fill_figures(self.figures, results)
            if results is None or results.field is not None:
                self.field.show_results(results)
        state = "up to date with the scene" if calculation.complete else "not calculated"
        self.stage.setText(f"calculating: {calculation.stage}" if calculation.stage else state)
        self._show_state()
        self.problem.setText(calculation.problem)
        self.problem.setVisible(bool(calculation.problem))
        warnings = () if results is None else results.facts["warnings"]
        self.warnings.setText("\n".join(f"⚠ {warning}" for warning in warnings))
        self._warned.setVisible(bool(warnings))

    def _show_state(self) -> None:
        """Show what can be done now, and what is being done."""
        ready, rig, state = self.calculation.results is not None, self._document.rig, self.output.state
        free = ready and state == IDLE
        for name, possible in (
            ("drive", free), ("play", free and bool(rig)), ("stop", state not in (IDLE, STOPPING)),
        ):  # fmt: skip
            self.actions_by_name[name].setEnabled(possible)
        silent = "choose a rig to play" if ready and not rig else ""
        self._state.setText(silent if state == IDLE else self.output.text)
        self._state.setToolTip(self._state.text())
