"""The player of films: maps of fields on one surface over one time slider, and the response of a position."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtWidgets import QWidget

from wavefocus.gui.field_map import FieldMap, Plot, Real, decimating_curve, scaled_unit
from wavefocus.gui.surface import PlotSurface
from wavefocus.gui.theme import Themed
from wavefocus.gui.time_slider import TimeSlider
from wavefocus.rendering.arrays import Float64Array
from wavefocus.storage.units import quantity

Frame = NDArray[np.floating[Any]]
NOWHERE_MM = np.zeros((0, 2))


@dataclass(frozen=True, slots=True, eq=False)
class Film:
    """Fields of one surface over time.

    start_s, sample_rate_hz, samples: Time of the first sample, rate and number of samples of all of them.
    frames: Returns the values of each map at a sample, (positions,).
    sources_mm: Returns the places of the sources at a time, (sources, 2).
    marks, int64 (foci,): Samples of the focus instants.
    response: Returns a title and the responses (samples,) of a position, by its place on the surface.
    unit: Of the responses.
    scales: Title of the colours of each map, and the value at their ends.
    """

    surface: PlotSurface
    start_s: float
    sample_rate_hz: float
    samples: int
    frames: Callable[[int], Sequence[Frame]]
    sources_mm: Callable[[float], Float64Array]
    marks: NDArray[np.int64]
    response: Callable[[int], tuple[str, Sequence[Real]]]
    unit: str
    scales: Sequence[tuple[str, float]]


class ResponsePlot(Plot):
    """The responses of one position.

    looks: Number of the colour and width of each line.
    """

    #: A time of the film in seconds that was clicked.
    time_wanted = pyqtSignal(float)

    def __init__(self, looks: Sequence[tuple[int, float]]) -> None:
        words = "time (s); click: show that instant"
        super().__init__("Response of the position that was clicked", words, "", axis_px=64)
        self.setMinimumHeight(90)
        self.curves = [decimating_curve() for _ in looks]
        self._now = pyqtgraph.InfiniteLine(0.0)
        self._now.setPen(pyqtgraph.mkPen(self.theme.fault, width=1.2))
        for curve, (colour, width) in zip(self.curves, looks, strict=True):
            curve.setPen(pyqtgraph.mkPen(self.theme.trace(colour), width=width))
        for item in (*self.curves, self._now):
            self.getPlotItem().addItem(item)
        self.scene().sigMouseClicked.connect(self._clicked)
        self.clear_response()

    def clear_response(self) -> None:
        for curve in self.curves:
            curve.setData([], [])
        self._now.hide()
        self.title("click a position on the map for its response", faint=True, size="9pt")

    def show_response(self, title: str, unit: str, time_s: Float64Array, lines: Sequence[Real]) -> None:
        """Draw the lines; one that is not known, NaN, is left out."""
        known = [line for line in lines if np.isfinite(line).all()]
        largest = max((float(np.abs(line).max(initial=0.0)) for line in known), default=0.0)
        factor, unit = scaled_unit(unit, largest)
        for curve, line in zip(self.curves, lines, strict=True):
            curve.setData(*((time_s, factor * line) if np.isfinite(line).all() else ([], [])))
        self._now.show()
        self.getPlotItem().setLabel("left", unit)
        self.title(title, size="9pt")
        self.setToolTip(f"{title}: largest {quantity(f'{factor * largest:.3g}', unit)}")
        self.getPlotItem().setXRange(float(time_s[0]), float(time_s[-1]), padding=0.01)
        end = 1.1 * factor * (largest or 1.0)
        self.getPlotItem().setYRange(-end, end, padding=0.0)

    def show_time(self, time_s: float) -> None:
        """Mark the instant that the maps show."""
        self._now.setValue(time_s)

    def _clicked(self, event) -> None:  # type: ignore[no-untyped-def]
        if self._now.isVisible() and event.button() == Qt.MouseButton.LeftButton and not event.double():
            self.time_wanted.emit(float(self.getPlotItem().getViewBox().mapSceneToView(event.scenePos()).x()))


class FilmPlayer(Themed, QWidget):
    """Shows a film; the owner lays out `maps`, `time` and `response`.

    names: Of the maps.
    looks: Of the lines of a position, as of `ResponsePlot`.
    """

    def __init__(self, names: Sequence[str], looks: Sequence[tuple[int, float]]) -> None:
        super().__init__()
        self.film: Film | None = None
        self.maps = [FieldMap(name) for name in names]
        self.time = TimeSlider()
        self.response = ResponsePlot(looks)
        self.response.time_wanted.connect(self._go_to)
        for one in self.maps:
            one.picked.connect(self.show_position)
            if one is not self.maps[0]:
                one.link(self.maps[0])
        self.time.moved.connect(self._moved)

    def show_film(self, film: Film | None) -> None:
        """Show a film at its first focus instant, or none; of the same bank, the part and the position shown stay."""
        former, view, zoomed = self.maps[0].surface, self.maps[0].box.viewRect(), self.maps[0].zoomed
        marked = self.marked
        self.film = film
        if film is None:
            self.time.show_samples(0.0, 1.0, 0)
            for one in self.maps:
                one.show_values(np.full(0 if one.surface is None else one.surface.positions, np.nan))
                one.show_sources(NOWHERE_MM)
            self.response.clear_response()
            return
        for one, (title, end) in zip(self.maps, film.scales, strict=True):
            one.show_surface(film.surface)
            one.show_scale(title, end, film.unit)
        same = former is not None and former.bank == film.surface.bank
        if zoomed and same:
            self.maps[0].keep_view(view)
        self.time.show_samples(film.start_s, film.sample_rate_hz, film.samples, film.marks)
        self.show_position(marked if same and former is not None and former.positions == film.surface.positions else -1)

    @property
    def marked(self) -> int:
        """Place on the surface of the position that is shown; -1 for none."""
        return self.maps[0].marked

    def show_position(self, place: int) -> None:
        """Mark a position on all maps, and show its response; -1 for none."""
        for one in self.maps:
            one.mark(place)
        film = self.film
        if film is None or not 0 <= place < film.surface.positions:
            self.response.clear_response()
            return
        title, lines = film.response(place)
        time_s = film.start_s + np.arange(film.samples) / film.sample_rate_hz
        self.response.show_response(title, film.unit, time_s, lines)
        self.response.show_time(self.time.time_s)

    def _moved(self, sample: int) -> None:
        if self.film is None:
            return
        sources_mm = self.film.sources_mm(self.time.time_s)
        for one, values in zip(self.maps, self.film.frames(sample), strict=True):
            one.show_values(values)
            one.show_sources(sources_mm)
        self.response.show_time(self.time.time_s)

    def _go_to(self, time_s: float) -> None:
        if self.film is not None:
            self.time.go_to(round((time_s - self.film.start_s) * self.film.sample_rate_hz))
