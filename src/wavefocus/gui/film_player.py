"""The player of films: maps of fields on one surface over one time slider."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PyQt5.QtCore import pyqtSignal
from PyQt5.QtWidgets import QWidget

from wavefocus.gui.field_map import FieldMap
from wavefocus.gui.surface import PlotSurface
from wavefocus.gui.theme import Themed
from wavefocus.gui.time_slider import TimeSlider
from wavefocus.rendering.arrays import Float64Array

Frame = NDArray[np.floating[Any]] | None
NOWHERE_MM = np.zeros((0, 2))


@dataclass(frozen=True, slots=True, eq=False)
class Film:
    """Fields of one surface over time.

    start_s, sample_rate_hz, samples: Time of the first sample, rate and number of samples of all of them.
    frames: Returns the values of each map at a sample, (positions,); None for a map that shows something else.
    sources_mm: Returns the places of the sources at a time, (sources, 2).
    marks, int64 (foci,): Samples of the focus instants.
    """

    surface: PlotSurface
    start_s: float
    sample_rate_hz: float
    samples: int
    frames: Callable[[int], Sequence[Frame]]
    sources_mm: Callable[[float], Float64Array]
    marks: NDArray[np.int64]


class FilmPlayer(Themed, QWidget):
    """Shows a film; the owner lays out `maps` and `time`, and sets the scales of the maps in `rescale`.

    names: Of the maps.
    """

    #: Position that was clicked, by its place on the surface.
    picked = pyqtSignal(int)
    #: Sample shown.
    moved = pyqtSignal(int)

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__()
        self.film: Film | None = None
        self.maps = [FieldMap(name) for name in names]
        self.time = TimeSlider()
        for one in self.maps:
            one.picked.connect(self.picked)
            if one is not self.maps[0]:
                one.link(self.maps[0])
        self.time.moved.connect(self._moved)

    def show_film(self, film: Film | None) -> None:
        """Show a film at its first focus instant, or none; of the same bank, the same part of the surface is shown."""
        former, view, zoomed = self.maps[0].surface, self.maps[0].box.viewRect(), self.maps[0].zoomed
        self.film = film
        if film is None:
            self.time.show_samples(0.0, 1.0, 0)
            for one in self.maps:
                one.show_values(np.full(0 if one.surface is None else one.surface.positions, np.nan))
                one.show_sources(NOWHERE_MM)
            return
        for one in self.maps:
            one.show_surface(film.surface)
        if zoomed and former is not None and former.bank == film.surface.bank:
            self.maps[0].keep_view(view)
        self.rescale()
        self.time.show_samples(film.start_s, film.sample_rate_hz, film.samples, film.marks)

    def rescale(self) -> None:
        """Set the scales of the maps."""
        raise NotImplementedError

    def show_again(self) -> None:
        """Show the same instant with other scales."""
        if self.film is not None:
            self.rescale()
            self.show_instant()

    def mark(self, place: int) -> None:
        """Mark a position on all maps; -1 for none."""
        for one in self.maps:
            one.mark(place)

    def show_instant(self) -> None:
        """Show the sample that the slider is at."""
        if self.film is None:
            return
        sources_mm = self.film.sources_mm(self.time.time_s)
        for one, values in zip(self.maps, self.film.frames(self.time.sample), strict=True):
            if values is not None:
                one.show_values(values)
            one.show_sources(sources_mm)

    def _moved(self, sample: int) -> None:
        if self.film is not None:
            self.show_instant()
            self.moved.emit(sample)
