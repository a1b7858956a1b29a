"""The map of a campaign, coloured by status or by a quality figure, selected by mouse and keyboard; its legend."""

from collections.abc import Iterable

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5.QtCore import QPointF, QRectF, Qt, pyqtSignal
from PyQt5.QtGui import QKeyEvent
from PyQt5.QtWidgets import QGraphicsRectItem, QLabel, QSizePolicy, QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.campaign.model import (
    FIGURES,
    LOOKS,
    NOT_MEASURED,
    CampaignModel,
    QualityMetric,
    look_index,
    status_text,
)
from wavefocus.gui.field_map import ColourBar
from wavefocus.gui.surface import PlotSurface
from wavefocus.gui.surface_view import MARK, Keys, PointMm, Spots, SurfaceView, map_colours, rgba
from wavefocus.gui.theme import Themed
from wavefocus.rendering.arrays import Float32Array
from wavefocus.storage.bank.ledger import Status


class SurfaceMap(SurfaceView):
    """The map; arrow keys walk from position to position, Space selects, Ctrl+A selects all, Esc nothing.

    A click shows a position, Ctrl-click selects it; a drag with Shift selects the rectangle, with Ctrl, too, adds it.
    """

    shown_changed = pyqtSignal(int)

    def __init__(self) -> None:
        self.selected: set[int] = set()
        self._status: NDArray[np.uint8] = np.zeros(0, np.uint8)
        self._marked_status: bytes = b""
        self.levels: tuple[float, float] | None = None
        """Values at the ends of the colour bar; None while the status is shown."""
        self.beyond = False, False
        self.colour_map = pyqtgraph.colormap.get("viridis")
        super().__init__("Map of the surface")
        self.setAccessibleDescription("Arrow keys go from position to position, Space selects")
        self._marks = self.add_spots(30, "o", 7, self.theme.text, self.theme.base)
        self._selection = self.add_spots(31, "s", 11, pyqtgraph.mkPen(MARK, width=2.0))
        self._current = [
            self.add_spots(32, "o", 17, pyqtgraph.mkPen("#000000", width=4.5)),
            self.add_spots(33, "o", 17, pyqtgraph.mkPen("#ffffff", width=2.0)),
        ]
        self._selecting = QGraphicsRectItem()
        self.add_item(self._selecting, 100)
        self._selecting.hide()
        self._selecting.setPen(pyqtgraph.mkPen(self.theme.text, width=0, style=Qt.PenStyle.DashLine))
        self.picked.connect(self.show_position)

    @property
    def shown(self) -> int:
        """The position whose details are shown, -1 for none."""
        return self.marked

    def show_surface(self, surface: PlotSurface | None) -> None:
        super().show_surface(surface)
        self._status = np.zeros(0 if surface is None else surface.positions, np.uint8)
        self._marked_status = b""
        if surface is None:
            for item in (self._marks, *self._current):
                item.clear()
        self.show_position(-1)
        self.select([])

    def show_status(self, status: NDArray[np.uint8]) -> None:
        self._status = status
        self.levels = None
        colours = np.array([rgba(look.colour(self.theme)) for look in LOOKS], np.uint8)
        self.paint(colours[look_index(status)])
        self._draw_marks()

    def show_figure(self, figure: QualityMetric, values: Float32Array, status: NDArray[np.uint8]) -> None:
        """Colour by a quality figure; positions without one look as not measured."""
        self._status = status
        known = values[np.isfinite(values)]
        # a few outliers must not press all others into one colour
        outliers = 1.0 if known.size > 100 and figure.key != "attempts" else 0.0
        low, high = np.percentile(known, [outliers, 100.0 - outliers]).tolist() if known.size else (0.0, 1.0)
        self.beyond = bool(known.size and known.min() < low), bool(known.size and known.max() > high)
        if figure.key == "attempts":
            low, high = min(low, 1.0), max(high, 2.0)
        if high - low < 1e-9 * max(1.0, abs(high)):
            low, high = low - 0.5, high + 0.5
        self.levels = low, high
        self.paint(map_colours(self.colour_map, values, (low, high), self.theme.cell))
        self._draw_marks()

    def show_current(self, position: int | None) -> None:
        """Ring the position that is being measured."""
        for ring in self._current:
            self._put(ring, [] if position is None else [position])

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
        around = QRectF(QPointF(*start_mm), QPointF(*at_mm)).normalized()
        self._selecting.setRect(around)
        self._selecting.setVisible(not ended)
        if ended and self.surface is not None:
            places = enumerate(self.surface.position_mm.tolist())
            inside = {number for number, at in places if around.contains(*at)}
            self.select(self.selected | inside if keys & Qt.KeyboardModifier.ControlModifier else inside)

    def _draw_marks(self) -> None:
        """Draw shapes over positions that are not valid; again only when a status has changed."""
        index = look_index(self._status)
        if self.surface is None or len(index) != self.surface.positions or index.tobytes() == self._marked_status:
            return
        self._marked_status = index.tobytes()
        ink = "#ffffff" if self.levels is not None else self.theme.text
        bad = np.flatnonzero(index < len(LOOKS) - 2)
        self._marks.setData(
            pos=self.surface.position_mm[bad],
            symbol=[LOOKS[look].symbol for look in index[bad]],
            size=7,
            pen=pyqtgraph.mkPen(ink, width=1),
            brush=pyqtgraph.mkBrush(self.theme.base),
        )

    def _put(self, item: Spots, positions: list[int]) -> None:
        if self.surface is None:
            item.setData(pos=np.zeros((0, 2)))
            return
        inside = [position for position in positions if position < self.surface.positions]
        item.setData(pos=self.surface.position_mm[inside].reshape(-1, 2))
        item.setVisible(bool(inside))  # even an empty one takes time to paint


# Characters like the shapes over the cells.
_SIGNS = {"d": "◆", "+": "+", "x": "×", "s": "■", "t": "▼", "": "&nbsp;"}


class MapPanel(Themed, QWidget):
    """Draws the campaign's map, and below it the statuses with their counts, or a colour bar."""

    def __init__(self, campaign: CampaignModel) -> None:
        super().__init__()
        self._campaign = campaign
        self._drawn = {"surface": -1, "map": -1}
        self.planned: PlotSurface | None = None
        """What the run file describes; drawn while there is no bank."""
        self.map = SurfaceMap()
        self.bar = ColourBar(self.map.colour_map)
        self.counts = ui.label("Statuses of the positions", any_width=True)
        tip = "Colour of the map; residual and coherence are the worst actuator's"
        self.colour_by = ui.choice("Colour of the map", tip, ["status", *(figure.label for figure in FIGURES)])
        self.colour_by.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        controls = ui.row(QLabel("Colour by"), (self.colour_by, 1))
        ui.column(controls, (self.map, 1), self.counts, self.bar, owner=self)
        self.forget()
        self.colour_by.currentIndexChanged.connect(self._colour)

    def show_plan(self, planned: PlotSurface | None) -> None:
        """Show another plan while there is no bank."""
        self.planned = planned
        if self._campaign.surface is None:
            self.forget()

    def forget(self) -> None:
        """Show the plan, or nothing: another bank will be followed."""
        self._drawn = {"surface": -1, "map": -1}
        self.map.show_surface(self.planned)
        unmeasured = np.zeros(0 if self.planned is None else self.planned.positions, np.uint8)
        self.map.show_status(unmeasured)
        self.counts.setText("" if self.planned is None else _counts_text(unmeasured))
        self.counts.show()
        self.bar.hide()

    def draw(self) -> None:
        campaign, revision = self._campaign, self._campaign.revision
        if campaign.surface is None:
            return
        if self._drawn["surface"] != revision["surface"]:
            self._drawn = {"surface": revision["surface"], "map": -1}
            self.map.show_surface(campaign.surface)
        if self._drawn["map"] != revision["map"]:
            self._drawn["map"] = revision["map"]
            self._colour()

    def _colour(self) -> None:
        campaign, index = self._campaign, self.colour_by.currentIndex() - 1
        if campaign.surface is None or self.map.surface is not campaign.surface:
            return
        values = campaign.figures.get(FIGURES[index].key) if index >= 0 else None
        if values is None or len(values) != len(campaign.status):
            self.map.show_status(campaign.status)
            self.counts.setText(_counts_text(campaign.status))
        else:
            figure = FIGURES[index]
            self.map.show_figure(figure, values, campaign.status)
            self.bar.show_range(figure.title, figure.unit, self.map.levels or (0.0, 1.0), self.map.beyond)
        self.counts.setVisible(self.map.levels is None)
        self.bar.setVisible(self.map.levels is not None)
        self.map.show_current(campaign.session.position)


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
