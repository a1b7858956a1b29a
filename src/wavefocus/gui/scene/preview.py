"""The live preview of a scene, made in a thread: the surface, each source's path and points, the signal, problems."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from PyQt5.QtCore import QObject, pyqtSignal

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.config.loading import read_toml
from wavefocus.config.scene import SceneConfig
from wavefocus.gui.scene.document import SceneDocument, build_draft
from wavefocus.gui.surface import VIRTUAL, PlotSurface, path_line, surface_from, surface_of
from wavefocus.gui.tab import TabContext
from wavefocus.rendering.arrays import Float64Array
from wavefocus.storage.errors import InputError, WavefocusError

if TYPE_CHECKING:
    from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
    from wavefocus.rendering.scene.model import Source


# More points than these look like a line; the figures count all of them.
MAX_DRAWN = 2000


@dataclass(frozen=True, slots=True, eq=False)
class Backdrop:
    """What a scene is drawn over: a bank's surface, or only an outline.

    outline_mm, float64 (points, 2): Rim of the surface, closed; a rectangle about the positions where the bank does not
        have it.
    usable, bool (positions,): Positions that hold a valid measurement.
    """

    outline_mm: Float64Array
    surface: PlotSurface | None = None
    grid: PositionGrid | None = None
    usable: NDArray[np.bool_] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """One source as it is drawn.

    line_mm, float64 (n, 2): Its path, NaN where it jumps from stroke to stroke.
    points_mm, instant_s, arrays (k, 2), (k,): Path points, and when each is a focus; thinned where there are many.
    off, bool (k,): Points further than one grid spacing from every position, or nearest to one without a measurement.
    """

    line_mm: Float64Array
    points_mm: Float64Array
    instant_s: Float64Array
    off: NDArray[np.bool_]


_TOPIC = "bank of the scene"


class LivePreview(QObject):
    """Draws the latest scene.

    backdrop: What it is drawn over.
    problem: Why commands would refuse the scene, or what cannot be drawn of it; empty where nothing is wrong.
    """

    updated = pyqtSignal()
    backdrop_changed = pyqtSignal()

    def __init__(self, context: TabContext, document: SceneDocument) -> None:
        super().__init__(document)
        self._context, self._document = context, document
        self.backdrop = _bare_backdrop(document.rig)
        self.problem = ""
        self._traces: Sequence[Trace] = ()
        self._shown = document.draft, self.backdrop
        self._lost: Path | None = None
        for signal in (document.changed, document.file_changed):
            signal.connect(self._ask)
        document.bank_changed.connect(self.read_bank)
        document.rig_changed.connect(lambda: None if document.bank else self.read_bank())

    @property
    def idle(self) -> bool:
        """Whether the preview is of the present scene."""
        draft, backdrop = self._shown
        return draft == self._document.draft and backdrop is self.backdrop

    @property
    def traces(self) -> Sequence[Trace]:
        """The sources as they are drawn; points snapped to another bank's positions are out of date."""
        return self._traces if self._shown[1] is self.backdrop else ()

    def read_bank(self) -> None:
        """Read the bank's surface; again when a campaign may have filled it."""
        bank = self._document.bank
        if bank is None:
            self._use_backdrop(_bare_backdrop(self._document.rig))
        else:
            read, failed = partial(_backdrop_of, bank), partial(self._no_bank, bank)
            self._context.background.ask("surface", read, self._use_backdrop, failed)

    def poll(self) -> None:
        """Read a bank again that could not be read, once its file is back."""
        if self._lost is not None and self._lost == self._document.bank and self._lost.exists():
            self._lost = None
            self.read_bank()

    def _ask(self) -> None:
        document, shown = self._document, (self._document.draft, self.backdrop)
        work = partial(_sources_of, *shown, document.place, self.traces)
        self._context.background.ask("preview", work, partial(self._show, shown), self._context.report_failure)

    def _show(self, shown: tuple[SceneConfig, Backdrop], drawn: tuple[Sequence[Trace], str]) -> None:
        self._shown, (self._traces, self.problem) = shown, drawn
        self.updated.emit()

    def _no_bank(self, bank: Path, why: Exception) -> None:
        if self._document.bank == bank:
            self._show_backdrop(_bare_backdrop(self._document.rig))
            self._lost = None if bank.exists() else bank
        self._context.report_failure(why, _TOPIC)

    def _use_backdrop(self, backdrop: Backdrop) -> None:
        self._lost = None
        self._context.settle(_TOPIC)
        self._show_backdrop(backdrop)

    def _show_backdrop(self, backdrop: Backdrop) -> None:
        self.backdrop = backdrop
        self.backdrop_changed.emit()
        self._ask()


def _bare_backdrop(rig: str) -> Backdrop:
    """The outline of a rig file's surface; the default one without a file that can be read."""
    table: object = {}
    if rig not in ("", VIRTUAL):
        with suppress(InputError):  # reported by what plays on it
            table = read_toml(Path(rig)).get("surface", {})
    return Backdrop(surface_from(table).outline.line(180))


def _backdrop_of(path: Path) -> Backdrop:
    from wavefocus.rendering.greens.interpolation.base import bank_grid  # loads scipy and h5py, in a thread
    from wavefocus.rendering.greens.source import usable
    from wavefocus.storage.bank.reading import open_bank

    with open_bank(path) as bank:
        surface, grid, allowed = surface_of(bank), bank_grid(bank), usable(bank)
    outline_mm = surface.outline_mm
    if outline_mm is None:
        (left, bottom), (right, top) = surface.position_mm.min(axis=0), surface.position_mm.max(axis=0)
        outline_mm = np.array([[left, bottom], [right, bottom], [right, top], [left, top], [left, bottom]])
    return Backdrop(outline_mm, surface, grid, allowed)


def _sources_of(
    draft: SceneConfig, backdrop: Backdrop, place: Path, former: Sequence[Trace]
) -> tuple[Sequence[Trace], str]:
    """Build the scene as commands do, and sample its sources as far as they are drawn; one that is refused stays.

    place: The scene file, for messages and for the files that the scene names.
    """
    try:
        sources = build_draft(draft, place).sources
        return [_drawn(source, index, backdrop) for index, source in enumerate(sources)], ""
    except WavefocusError as error:
        return (former, str(error)) if draft.source else ((), "")


def _drawn(source: Source, index: int, backdrop: Backdrop) -> Trace:
    from wavefocus.rendering.scene.sampling import point_count
    from wavefocus.rendering.scene.trajectory import TrajectoryPath

    points = point_count(source, index)
    moves = points > 1 or (source.path.length_mm > 0 and source.speed_mm_s > 0)
    number = evenly_spread(points, MAX_DRAWN)
    if isinstance(source.path, TrajectoryPath):
        instant_s, points_mm = (part[number] for part in source.path.foci(source.start_s))
    else:
        period_s = source.step_mm / source.speed_mm_s if moves else 0.0
        if not math.isfinite(source.start_s + points * period_s):
            raise InputError(f"source {index}: its last focus is later than numbers reach; raise speed_mm_s")
        instant_s = np.asarray(source.start_s + number * period_s, np.float64)
        points_mm = source.path.point_at(number * (source.step_mm if points > 1 else 0.0))
    if not np.isfinite(points_mm).all():
        raise InputError(f"source {index}: a path point is further away than numbers reach")
    off = np.zeros(len(points_mm), np.bool_)
    if backdrop.grid is not None and backdrop.usable is not None:
        rows, distance_mm = backdrop.grid.nearest(points_mm)
        off = (distance_mm > backdrop.grid.spacing_mm * (1.0 + 1e-9) + 1e-9) | ~backdrop.usable[rows]
    return Trace(
        line_mm=path_line(source.path, int(min(8.0 * source.path.length_mm, 6000)) + 3),
        points_mm=points_mm,
        instant_s=instant_s,
        off=off,
    )
