"""The map of a campaign, coloured by status or by a quality figure, selected by mouse and keyboard; its legend."""

from collections.abc import Iterable

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtGui import QKeyEvent
from PyQt5.QtWidgets import QLabel, QSizePolicy, QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.campaign.model import FIGURES, LOOKS, NOT_MEASURED, CampaignModel, look_index, status_text
from wavefocus.gui.field_map import ColourBar
from wavefocus.gui.surface import PlotSurface
from wavefocus.gui.surface_view import MARK, Keys, PointMm, Spots, SurfaceView, draw_line, map_colours, rgba
from wavefocus.gui.theme import Themed
from wavefocus.rendering.arrays import Float32Array
from wavefocus.storage.bank.ledger import Status


class _SurfaceMap(SurfaceView):
    """The map; arrow keys walk from position to position, Space selects, Ctrl+A selects all, Esc nothing.

    A click shows a position, Ctrl-click selects it; a drag with Shift selects the rectangle, with Ctrl, too, adds it.
    """

    shown_changed = pyqtSignal(int)

    def __init__(self) -> None:
        self.selected: set[int] = set()
        self._status: NDArray[np.uint8] = np.zeros(0, np.uint8)
        super().__init__("Map of the surface")
        self.setAccessibleDescription("Arrow keys go from position to position, Space selects")
        self._marks = self.add_spots(40, "o", 7, self.theme.text, self.theme.base)
        self._selection = self.add_spots(41, "s", 11, pyqtgraph.mkPen(MARK, width=2))
        self._current = self.add_spots(42, "o", 17, pyqtgraph.mkPen(self.theme.text, width=3))
        self._rectangle = self.add_line(100, pyqtgraph.mkPen(self.theme.text, style=Qt.PenStyle.DashLine))
        self.picked.connect(self.show_position)

    @property
    def shown(self) -> int:
        """The position whose details are shown, -1 for none."""
        return self.marked

    def show_surface(self, surface: PlotSurface | None) -> None:
        super().show_surface(surface)
        for item in (self._marks, self._current):
            item.clear()
        self.show_position(-1)
        self.select([])

    def _show_status(self, status: NDArray[np.uint8], colours: NDArray[np.uint8], current: int | None) -> None:
        """Colour the positions, with shapes over those that are not good and a ring round the one being measured."""
        self._status = status
        self.paint(colours)
        index = look_index(status)
        bad = np.flatnonzero(index < len(LOOKS) - 2)
        self._put(self._marks, bad, symbol=[LOOKS[look].symbol for look in index[bad]])
        self._put(self._current, [] if current is None else [current])

    def show_position(self, position: int) -> None:
        """Mark the position whose details are shown; -1 for none."""
        self.mark(position)
        self.shown_changed.emit(position)

    def select(self, positions: Iterable[int]) -> None:
        """Select these and no others."""
        self.selected = {int(position) for position in positions}
        self._put(self._selection, sorted(self.selected))

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
        assert event is not None
        key = event.key()
        if key == Qt.Key.Key_Space and self.shown >= 0:
            self.select(self.selected ^ {self.shown})
        elif key == Qt.Key.Key_A and event.modifiers() & Qt.KeyboardModifier.ControlModifier and self.surface:
            self.select(range(self.surface.positions))
        elif key == Qt.Key.Key_Escape and self.selected:
            self.select([])
        else:
            super().keyPressEvent(event)

    def position_text(self, position: int) -> str:
        return f"{super().position_text(position)}: {status_text(int(self._status[position]))}"

    def click_at(self, at_mm: PointMm, keys: Keys) -> None:
        position = self.position_at(at_mm)
        if position >= 0 and keys & Qt.KeyboardModifier.ControlModifier:
            self.select(self.selected ^ {position})
        else:
            super().click_at(at_mm, keys)

    def claims_drag(self, _at_mm: PointMm, keys: Keys) -> bool:
        return bool(keys & Qt.KeyboardModifier.ShiftModifier)

    def drag_to(self, start_mm: PointMm, at_mm: PointMm, keys: Keys, *, ended: bool) -> None:
        (left, bottom), (right, top) = (low, high) = np.sort([start_mm, at_mm], axis=0)
        rim_mm = np.array([(left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)])
        draw_line(self._rectangle, [] if ended else [rim_mm])
        if ended and self.surface is not None:
            place_mm = self.surface.position_mm
            inside = set(np.flatnonzero(((place_mm >= low) & (place_mm <= high)).all(axis=1)).tolist())
            self.select(self.selected | inside if keys & Qt.KeyboardModifier.ControlModifier else inside)

    def _put(self, item: Spots, positions: Iterable[int], **looks: object) -> None:
        surface = self.surface
        inside = [] if surface is None else [position for position in positions if position < surface.positions]
        item.setData(pos=np.zeros((0, 2)) if surface is None else surface.position_mm[inside].reshape(-1, 2), **looks)
        item.setVisible(bool(inside))  # even an empty one takes time to paint


# Characters like the shapes over the cells.
_SIGNS = {"d": "◆", "+": "+", "x": "×", "s": "■", "t": "▼", "": "&nbsp;"}


class MapPanel(Themed, QWidget):
    """Draws the campaign's map, and below it the statuses with their counts, or a colour bar.

    planned: What the run file describes; drawn while there is no bank.
    levels: Values at the ends of the colour bar; None while the status is shown.
    """

    def __init__(self, campaign: CampaignModel) -> None:
        super().__init__()
        self._campaign = campaign
        self._drawn: tuple[object, ...] = ()
        self.planned: PlotSurface | None = None
        self.levels: tuple[float, float] | None = None
        self.map = _SurfaceMap()
        self._colours = pyqtgraph.colormap.get("viridis")
        self.bar = ColourBar(self._colours)
        self._counts = ui.label("Statuses of the positions", any_width=True)
        tip = "Colour of the map; residual and coherence are the worst actuator's"
        self.colour_by = ui.choice("Colour of the map", tip, ["status", *(title for title, _ in FIGURES.values())])
        self.colour_by.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        controls = ui.row(QLabel("Colour by"), (self.colour_by, 1))
        ui.column(controls, (self.map, 1), self._counts, self.bar, owner=self)
        self.colour_by.currentIndexChanged.connect(self.draw)
        self.draw()

    def draw(self) -> None:
        """Draw what has changed."""
        campaign, index = self._campaign, self.colour_by.currentIndex()
        surface = campaign.surface or self.planned
        drawn = surface, campaign.revision["map"], index
        if drawn == self._drawn:
            return
        if not self._drawn or surface is not self._drawn[0]:
            self.map.show_surface(surface)
        self._drawn = drawn
        status = campaign.status if campaign.surface else np.zeros(surface.positions if surface else 0, np.uint8)
        values = campaign.figures.get([*FIGURES][index - 1]) if index > 0 else None
        if values is None or len(values) != len(status):
            self.levels = None
            colours = np.array([rgba(look.colour(self.theme)) for look in LOOKS], np.uint8)[look_index(status)]
            self._counts.setText("" if surface is None else _counts_text(status))
        else:
            self.levels = _levels_of(values)
            colours = map_colours(self._colours, values, self.levels, self.theme.cell)
            self.bar.show_range(self.colour_by.currentText(), "", self.levels)
        self._counts.setVisible(self.levels is None)
        self.bar.setVisible(self.levels is not None)
        self.map._show_status(status, colours, campaign.session.position)


def _levels_of(values: Float32Array) -> tuple[float, float]:
    """Ends of the colours; a few outliers must not press all others into one colour."""
    known = values[np.isfinite(values)]
    outliers = 1.0 if known.size > 100 else 0.0
    low, high = np.percentile(known, [outliers, 100.0 - outliers]).tolist() if known.size else (0.0, 1.0)
    alike = high - low < 1e-9 * max(1.0, abs(high))
    return (low - 0.5, high + 0.5) if alike else (low, high)


def _counts_text(status: NDArray[np.uint8]) -> str:
    """Looks of the statuses as rich text, and how many positions have each."""
    theme, counts = Themed.theme, np.bincount(look_index(status), minlength=len(LOOKS)).tolist()
    swatch = f"<span style='color: {theme.text}; background-color: {{}}'>&nbsp;{{}}&nbsp;</span>"
    parts = [
        f"{swatch.format(look.colour(theme), _SIGNS[look.symbol])}&nbsp;{look.word}&nbsp;{count}"
        for look, count in zip(LOOKS, counts, strict=True)
        if count > 0 or look.bit in (Status.VALID, NOT_MEASURED)
    ]
    return "&nbsp;&nbsp; ".join(reversed(parts))
