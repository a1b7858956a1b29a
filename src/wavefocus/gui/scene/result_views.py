"""Drives and predicted field of a scene: traces, levels, and the field as a movie with a position's response."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyqtgraph
from PyQt5.QtCore import QSize
from PyQt5.QtWidgets import QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.field_map import Plot, Real, decimating_curve, whole_ticks
from wavefocus.gui.film_player import NOWHERE_MM, Film, FilmPlayer, Frame
from wavefocus.gui.scene.calculation import SceneResults
from wavefocus.gui.surface import PlotSurface, surface_of
from wavefocus.gui.theme import Themed
from wavefocus.rendering.arrays import Float64Array
from wavefocus.storage.errors import InputError
from wavefocus.storage.units import quantity

if TYPE_CHECKING:
    from wavefocus.storage.drive_file import Drive
    from wavefocus.storage.field_file import Field

_ALL = "all actuators"
_STEP = 0.45  # the loudest trace fills so much of the distance to its neighbours, up and down
_ROOM = 1.15
_AXIS_PX = 58


class DrivesView(Themed, QWidget):
    """Shows the drives of all actuators."""

    def __init__(self) -> None:
        super().__init__()
        self.results: SceneResults | None = None
        self.actuator = ui.choice("Actuator shown", "All drives, or the drive of one actuator", [_ALL])
        self.traces, self.levels = TracePlot(), LevelPlot()
        both = ui.stacked((self.traces, 330), (self.levels, 180), growing=[0])
        choices = ui.row(self.actuator, None, margins=(4, 4, 4, 2))
        ui.column(choices, (both, 1), owner=self, spacing=2)
        self.actuator.currentIndexChanged.connect(lambda _choice: self.show_drives())

    def sizeHint(self) -> QSize:  # noqa: N802
        return QSize(480, 300)

    def show_results(self, results: SceneResults | None) -> None:
        """Show drives, or none."""
        self.results = results
        if results is not None and self.actuator.count() != len(results.drive.drive_v) + 1:
            names = (f"actuator {number}" for number in range(len(results.drive.drive_v)))
            ui.fill_choice(self.actuator, [_ALL, *names])
        self.show_drives()

    def show_drives(self) -> None:
        """Show the drives as they are chosen."""
        chosen, drive = self.actuator.currentIndex() - 1, None if self.results is None else self.results.drive
        for plot in (self.traces, self.levels):
            for side in ("left", "bottom"):
                plot.getPlotItem().showAxis(side, drive is not None)
        self.traces.show_drive(drive, chosen)
        self.levels.getPlotItem().clear()
        if drive is not None:
            self.levels.show_drive(drive, chosen)


class TracePlot(Plot):
    """Drives over time."""

    def __init__(self) -> None:
        super().__init__("Drives of all actuators", "time (s)", "actuator", axis_px=_AXIS_PX)
        self._ends = 0.0, 0.0
        self._curves: list[pyqtgraph.PlotDataItem] = []

    def show_drive(self, drive: Drive | None, chosen: int) -> None:
        plot = self.getPlotItem()
        if drive is None:
            self._show_curves(np.zeros(0), [], 1.0)
            self.title("no drives to show", faint=True, size="9pt")
            return
        volts = drive.drive_v if chosen < 0 else drive.drive_v[chosen : chosen + 1]
        time_s = drive.start_s + np.arange(volts.shape[1]) / drive.sample_rate_hz
        largest = float(np.abs(volts).max(initial=0.0))
        if chosen >= 0:
            self._show_curves(time_s, [volts[0]], 1.4)
            plot.setLabel("left", f"actuator {chosen} ({drive.drive_unit})")
            plot.getAxis("left").setTicks(None)
            plot.setYRange(-_ROOM * (largest or 1.0), _ROOM * (largest or 1.0), padding=0.0)
            title = f"largest {quantity(f'{largest:.3g}', drive.drive_unit)}"
        else:
            scale = _STEP / (largest or 1.0)
            self._show_curves(time_s, [one + scale * trace for one, trace in enumerate(volts)], 1.0)
            plot.setLabel("left", "actuator")
            plot.getAxis("left").setTicks([whole_ticks(len(volts)), []])
            plot.setYRange(-1.0, len(volts), padding=0.0)
            title = f"a step is {quantity(f'{largest / _STEP:.3g}', drive.drive_unit)}"
        self.title(title, size="9pt")
        # A zoomed view stays while the scene is edited.
        ends = float(time_s[0]), float(time_s[-1])
        if ends != self._ends:
            self._ends = ends
            plot.setXRange(*ends, padding=0.01)

    def _show_curves(self, x: Real, curves: Sequence[Real], width: float) -> None:
        """Curves are reused: thinned ones cannot be taken out of a plot."""
        pen = pyqtgraph.mkPen(self.theme.traces[0], width=width)
        while len(self._curves) < len(curves):
            self._curves.append(decimating_curve())
            self.getPlotItem().addItem(self._curves[-1])
        for number, curve in enumerate(self._curves):
            curve.setData(*((x, curves[number]) if number < len(curves) else ([], [])), pen=pen)


class LevelPlot(Plot):
    """Peak and rms of each actuator."""

    def __init__(self) -> None:
        super().__init__("Peak and rms of each actuator", "actuator", "level (V)", axis_px=_AXIS_PX)
        self.setToolTip("Level of each actuator's drive: outlined the peak, filled the rms over 1 s")

    def show_drive(self, drive: Drive, chosen: int) -> None:
        from wavefocus.rendering.drive.coil_limits import levels_of, peaks  # loaded by then, by another thread

        plot, theme, count = self.getPlotItem(), self.theme, len(drive.drive_v)
        plot.setLabel("left", f"level ({drive.drive_unit})")
        colours = [theme.traces[1] if one == chosen else theme.traces[0] for one in range(count)]
        peak_v = peaks(drive.drive_v)
        for values, filled in ((peak_v, False), (levels_of(drive.drive_v, drive.sample_rate_hz).rms_v, True)):
            plot.addItem(pyqtgraph.BarGraphItem(
                x=np.arange(count), y0=0.0, height=values, width=2 * 0.36 * (0.6 if filled else 1.0),
                pens=[pyqtgraph.mkPen(colour) for colour in colours],
                brushes=[pyqtgraph.mkBrush(colour if filled else theme.base) for colour in colours],
            ))  # fmt: skip
        plot.getAxis("bottom").setTicks([whole_ticks(count, 7), []])
        plot.setXRange(-0.7, count - 0.3, padding=0.0)
        plot.setYRange(0.0, _ROOM * max(float(peak_v.max(initial=0.0)), 1e-12), padding=0.0)


class FieldView(FilmPlayer):
    """Plays the scene's predicted field, or that of a file, with the response of a position."""

    def __init__(self) -> None:
        super().__init__(["response"], [(0, 1.0)])
        self.results: SceneResults | None = None
        self.field: Field | None = None
        self.file: Path | None = None
        self._largest = 0.0
        self._seen = False  # whether the instants of a scene's foci have been shown
        self.map, self.slider = self.maps[0], self.time
        tip = "End of the colour scale, as a part of the largest response (%)"
        self.span = ui.number_box("End of the colour scale", tip, " %", 0, 1.0, 1000.0, value=100.0, prefix="to ")
        self.name = ui.label("Field file shown", any_width=True)
        self.close_file = ui.tool_button("Close file", "Show the field of the scene again", self._close_file)
        self._file_row = QWidget()
        ui.row((self.name, 1), self.close_file, owner=self._file_row, margins=(4, 2, 4, 0))
        self._file_row.hide()
        # The slider's own row is as wide as the panel without the speed.
        choices = ui.row(self.span, self.slider.slower, None, margins=(4, 4, 4, 0))
        upper = QWidget()
        ui.column(self._file_row, choices, (self.map, 1), self.map.bar, self.slider, owner=upper, spacing=3)
        ui.column(ui.stacked((upper, 420), (self.response, 130), growing=[0]), owner=self)
        self.span.valueChanged.connect(lambda _value: self.show_again())

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
        self._show_field(field, surface)

    def rescale(self) -> None:
        if self.field is not None:
            top = (self._largest or 1.0) * self.span.value() / 100.0
            self.map.show_scale("response", (-top, top), self.field.response_unit, (True, True))

    def _show_scene(self) -> None:
        results = self.results
        if results is None or results.field is None:
            self._seen = False
            self._show_field(None, None)
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
        field: Field | None,
        surface: PlotSurface | None,
        marks_s: Float64Array = np.zeros(0),  # noqa: B008
        sources_mm: Callable[[float], Float64Array] = lambda _time_s: NOWHERE_MM,
    ) -> None:
        at_s = self.slider.time_s
        self.field = field
        if field is None or surface is None:
            self.show_film(None)
            return
        self._largest = float(np.abs(field.field).max())
        marks = np.rint((marks_s - field.start_s) * field.sample_rate_hz).astype(np.int64)
        self.show_film(
            Film(
                surface, field.start_s, field.sample_rate_hz, field.field.shape[1], self._frames, sources_mm, marks,
                self._response, field.response_unit,
            )
        )  # fmt: skip
        if self._seen and at_s >= field.start_s:
            self.slider.go_to(round((at_s - field.start_s) * field.sample_rate_hz))
        self._seen |= len(marks) > 0

    def _frames(self, sample: int) -> list[Frame]:
        assert self.field is not None
        return [self.field.field[:, sample]]

    def _response(self, place: int) -> tuple[str, list[Real]]:
        assert self.field is not None
        assert self.map.surface is not None
        x_mm, y_mm = self.map.surface.position_mm[place]
        return f"position {self.field.position_index[place]} at ({x_mm:.1f}, {y_mm:.1f}) mm", [self.field.field[place]]


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
