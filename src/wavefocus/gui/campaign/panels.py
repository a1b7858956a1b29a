"""Panels of the Campaign tab: buttons, progress, events with a filter, and the map with its legend."""

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import pyqtgraph
from numpy.typing import NDArray
from PyQt5 import QtWidgets
from PyQt5.QtCore import QModelIndex, Qt, pyqtSignal
from PyQt5.QtGui import QKeyEvent

from wavefocus.campaign.status import GOING_ON, CampaignStatus
from wavefocus.config.messages.campaign import State
from wavefocus.gui import widgets as ui
from wavefocus.gui.campaign import model
from wavefocus.gui.field_map import ColourBar
from wavefocus.gui.surface import PlotSurface
from wavefocus.gui.surface_view import MARK, Keys, PointMm, Spots, SurfaceView, draw_line, map_colours, rgba
from wavefocus.gui.theme import Themed
from wavefocus.rendering.arrays import Float32Array
from wavefocus.storage.bank.ledger import Status

# Name, text, key and tooltip.
_BUTTONS = (
    ("start", "Start", "Ctrl+Return", "Start the campaign of the run file in the bank, or continue it"),
    ("resume", "Resume", "Ctrl+R", "Continue the bank's campaign; the bank alone is enough"),
    ("pause", "Pause", "Ctrl+P", "Finish the current position, then wait, muted and parked"),
    ("stop", "Stop after this position", "Ctrl+T", "Finish the current position and end; Resume continues"),
    ("selected", "Remeasure selected", "Ctrl+M", "Measure the selected positions again (Ctrl-click, Shift-drag)"),
    ("poor", "Remeasure poor", "Ctrl+Shift+M", "Measure again all that is poor, over-range or failed"),
)


class Controls(QtWidgets.QWidget):
    """Row of buttons; `actions_by_name` are in the menu, too.

    acts: Action of each button.
    """

    def __init__(self, acts: dict[str, Callable[[], object]]) -> None:
        super().__init__()
        self.actions_by_name: dict[str, QtWidgets.QAction] = {}
        parts: list[QtWidgets.QWidget | int | None] = []
        for name, text, key, tip in _BUTTONS:
            action = self.actions_by_name[name] = ui.action(self, text, acts[name], key, tip=tip)
            action.setEnabled(False)
            parts += [ui.button(action), 10 if name == "stop" else 0]
        ui.row(*parts, None, owner=self)

    def show_possible(
        self, state: model.ShownState, *, has_run: bool, has_bank: bool, left: int, selected: int, poor: int
    ) -> None:
        """Enable what makes sense, and show how many positions would be measured again.

        has_run: Whether there is a run file and the name of a bank of it.
        left: Positions that are not measured.
        """
        word, free = state.word, not state.measuring
        orders = word in GOING_ON and word is not State.STOPPING
        for name, enabled, text in (
            ("start", free and has_run, "Start"),
            ("resume", free and has_bank and left > 0, "Resume"),
            ("pause", orders, "Continue" if state.paused else "Pause"),
            ("stop", orders or word in (model.Extra.PREPARING, model.Extra.SILENT), "Stop after this position"),
            ("selected", free and has_bank and selected > 0, f"Remeasure selected{f' ({selected})' * (selected > 0)}"),
            ("poor", free and has_bank and poor > 0, f"Remeasure poor{f' ({poor})' * (poor > 0)}"),
        ):
            self.actions_by_name[name].setEnabled(enabled)
            self.actions_by_name[name].setText(text)


class ProgressRow(Themed, QtWidgets.QWidget):
    """State, reason, progress bar and figures above the map."""

    def __init__(self) -> None:
        super().__init__()
        self.state = ui.Badge("State of the campaign")
        self.reason = ui.label("Reason of the state", any_width=True)
        self.bar = ui.progress_bar("Progress of the campaign", "%v of %m positions (%p %)")
        self.figures = ui.label("Rate, remaining time and finish time")
        self.faults = ui.label("Lasting faults", role="fault", wraps=True, selectable=True)
        row = ui.row(self.state, (self.reason, 3), (self.bar, 3), self.figures, spacing=10)
        ui.column(row, self.faults, owner=self)

    def show_state(self, state: model.ShownState, report: str, owner: str) -> None:
        """Show a state and its reason; `report` of the capture replaces the reason while it has none."""
        theme, word = self.theme, state.word
        colour = (
            theme.fault if word in (State.FAILED, model.Extra.GONE, model.Extra.SILENT)
            else theme.warning if word in GOING_ON and word is not State.RUNNING
            else theme.good if state.measuring or word is State.FINISHED
            else theme.faint
        )  # fmt: skip
        self.state.show_word(str(word), colour)
        reason = report or state.reason
        self.reason.setText(reason)
        self.reason.setToolTip(f"{reason}\n{owner}".strip())

    def show_faults(self, faults: Sequence[str]) -> None:
        """Show what is wrong and stays so: instruments whose last word is a fault, a bank of another run."""
        self.faults.setText("\n".join(f"▲ {fault}" for fault in faults))
        self.faults.setVisible(bool(faults))

    def show_progress(
        self, measured: int, total: int, session: CampaignStatus, state: model.ShownState, plan: str
    ) -> None:
        """Show the progress of the bank, or of the session while it runs and has measured a position; else a plan."""
        paced = state.measuring and session.progress is not None
        done, of = (session.done, session.total) if paced else (measured, total)
        self.bar.setTextVisible(of > 0)  # without a bank and a plan there is nothing to count
        self.bar.setMaximum(max(of, 1))
        self.bar.setValue(done)
        self.figures.setText(_pace_text(session, state.word) if paced else plan)


def _pace_text(session: CampaignStatus, word: State | model.Extra) -> str:
    """Rate and finish of a session; the finish only while positions are measured, for a pause may last."""
    progress, at = session.progress, session.progress_at
    if progress is None or at is None:
        return ""
    parts = [] if math.isnan(progress.per_hour) else [f"{progress.per_hour:.0f} positions an hour"]
    if word is State.RUNNING and not math.isnan(progress.wall_remaining_s):
        parts.append(ui.finish_text(at.timestamp() + progress.wall_remaining_s))
    return "  ·  ".join(parts)


class EventList(Themed, QtWidgets.QWidget):
    """Events; a double click gives the position concerned to `show`."""

    def __init__(self, campaign: model.CampaignModel, show: Callable[[int], object]) -> None:
        super().__init__()
        self._campaign, self._show = campaign, show
        self._position = -1
        self._trimmed = campaign.trimmed
        choices = ["everything", "notes and above", "warnings and faults", "faults"]
        tip = "Events shown here (all are in the log next to the bank)"
        self.weight = ui.choice("Least weight", tip, choices, model.Weight.NOTE)
        self.of_position = ui.check("this position", "Show only events of the position that is shown above")
        self.view = ui.table(("time", "weight", "event"), "Events", ())
        self.view.setShowGrid(False)
        self.view.setWordWrap(False)
        rows, columns, metrics = self.view.verticalHeader(), self.view.horizontalHeader(), self.fontMetrics()
        assert rows is not None
        assert columns is not None
        rows.setSectionResizeMode(QtWidgets.QHeaderView.ResizeMode.Fixed)  # there may be thousands
        rows.setDefaultSectionSize(metrics.height() + 5)
        columns.setSectionResizeMode(QtWidgets.QHeaderView.ResizeMode.Interactive)
        columns.setStretchLastSection(True)
        self.view.setColumnWidth(0, metrics.horizontalAdvance("Wed 00:00:00") + 18)
        self.view.setColumnWidth(1, metrics.horizontalAdvance("warning") + 22)
        title = ui.label(text="Events", role="strong")
        ui.column(ui.row(title, self.weight, self.of_position, None), (self.view, 1), owner=self)
        for changed in (self.weight.currentIndexChanged, self.of_position.toggled):
            changed.connect(self._restrict)
        self.view.doubleClicked.connect(self._want_position)

    def draw(self) -> None:
        """Add the lines that are new; a row of the table has the index of its line."""
        campaign, view = self._campaign, self.view
        gone = min(campaign.trimmed - self._trimmed, view.rowCount())
        first = view.rowCount() - gone
        self._trimmed = campaign.trimmed
        if not gone and first == len(campaign.lines):
            return
        bar, table = view.verticalScrollBar(), view.model()
        at_end = bar is None or bar.value() >= bar.maximum() - 1
        if table is not None:
            table.removeRows(0, gone)
        view.setRowCount(len(campaign.lines))
        colours = {model.Weight.FAULT: self.theme.fault, model.Weight.WARNING: self.theme.warning}
        for row, line in enumerate(campaign.lines[first:], first):
            colour = dict.fromkeys(range(3), colours[line.weight]) if line.weight in colours else {}
            ui.fill_row(view, row, (model.clock(line.at_s), line.weight.name.lower(), line.text), colour)
            view.setRowHidden(row, not self._accepts(line))
        if at_end:
            view.scrollToBottom()

    def show_position(self, position: int) -> None:
        """Note the position that "this position" means; -1 for none."""
        self._position = position
        if self.of_position.isChecked():
            self._restrict()

    def _accepts(self, line: model.EventLine) -> bool:
        position = self._position if self.of_position.isChecked() else -1
        return line.weight >= self.weight.currentIndex() and position in (-1, line.position)

    def _restrict(self) -> None:
        self.draw()
        for row, line in enumerate(self._campaign.lines):
            self.view.setRowHidden(row, not self._accepts(line))
        self.view.scrollToBottom()

    def _want_position(self, index: QModelIndex) -> None:
        if (position := self._campaign.lines[index.row()].position) >= 0:
            self._show(position)


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

    def show_surface(self, surface: PlotSurface | None) -> None:
        super().show_surface(surface)
        for item in (self._marks, self._current):
            item.clear()
        self.show_position(-1)
        self.select([])

    def show_status(self, status: NDArray[np.uint8], colours: NDArray[np.uint8], current: int | None) -> None:
        """Colour the positions, with shapes over those that are not good and a ring round the one being measured."""
        self._status = status
        self.paint(colours)
        index = model.look_index(status)
        bad = np.flatnonzero(index < len(model.LOOKS) - 2)
        self._put(self._marks, bad, symbol=[model.LOOKS[look].symbol for look in index[bad]])
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
        if key == Qt.Key.Key_Space and self.marked >= 0:
            self.select(self.selected ^ {self.marked})
        elif key == Qt.Key.Key_A and event.modifiers() & Qt.KeyboardModifier.ControlModifier and self.surface:
            self.select(range(self.surface.positions))
        elif key == Qt.Key.Key_Escape and self.selected:
            self.select([])
        else:
            super().keyPressEvent(event)

    def position_text(self, position: int) -> str:
        return f"{super().position_text(position)}: {model.status_text(int(self._status[position]))}"

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


class MapPanel(Themed, QtWidgets.QWidget):
    """Draws the campaign's map, and below it the statuses with their counts, or a colour bar.

    planned: What the run file describes; drawn while there is no bank.
    levels: Values at the ends of the colour bar; None while the status is shown.
    """

    def __init__(self, campaign: model.CampaignModel) -> None:
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
        self.colour_by = ui.choice(
            "Colour of the map", tip, ["status", *(title for title, _ in model.FIGURES.values())]
        )
        self.colour_by.setSizePolicy(QtWidgets.QSizePolicy.Policy.Ignored, QtWidgets.QSizePolicy.Policy.Fixed)
        controls = ui.row(QtWidgets.QLabel("Colour by"), (self.colour_by, 1))
        ui.column(controls, (self.map, 1), self._counts, self.bar, owner=self)
        self.colour_by.currentIndexChanged.connect(self.draw)
        self.draw()

    def draw(self) -> None:
        """Draw what has changed."""
        campaign, index = self._campaign, self.colour_by.currentIndex()
        surface = campaign.surface or self.planned
        drawn = surface, campaign.status, campaign.figures, campaign.session.position, index
        if self._drawn and all(one is other for one, other in zip(drawn, self._drawn, strict=True)):
            return
        if not self._drawn or surface is not self._drawn[0]:
            self.map.show_surface(surface)
        self._drawn = drawn
        status = campaign.status if campaign.surface else np.zeros(surface.positions if surface else 0, np.uint8)
        values = campaign.figures.get([*model.FIGURES][index - 1]) if index > 0 else None
        if values is None or len(values) != len(status):
            self.levels = None
            looks = np.array([rgba(look.colour(self.theme)) for look in model.LOOKS], np.uint8)
            colours = looks[model.look_index(status)]
            self._counts.setText("" if surface is None else _counts_text(status))
        else:
            self.levels = _levels_of(values)
            colours = map_colours(self._colours, values, self.levels, self.theme.cell)
            self.bar.show_range(self.colour_by.currentText(), "", self.levels)
        self._counts.setVisible(self.levels is None)
        self.bar.setVisible(self.levels is not None)
        self.map.show_status(status, colours, campaign.session.position)


def _levels_of(values: Float32Array) -> tuple[float, float]:
    """Ends of the colours; a few outliers must not press all others into one colour."""
    known = values[np.isfinite(values)]
    outliers = 1.0 if known.size > 100 else 0.0
    low, high = np.percentile(known, [outliers, 100.0 - outliers]).tolist() if known.size else (0.0, 1.0)
    alike = high - low < 1e-9 * max(1.0, abs(high))
    return (low - 0.5, high + 0.5) if alike else (low, high)


def _counts_text(status: NDArray[np.uint8]) -> str:
    """Looks of the statuses as rich text, and how many positions have each."""
    theme, counts = Themed.theme, np.bincount(model.look_index(status), minlength=len(model.LOOKS)).tolist()
    swatch = f"<span style='color: {theme.text}; background-color: {{}}'>&nbsp;{{}}&nbsp;</span>"
    parts = [
        f"{swatch.format(look.colour(theme), look.sign)}&nbsp;{look.word}&nbsp;{count}"
        for look, count in zip(model.LOOKS, counts, strict=True)
        if count > 0 or look.bit in (Status.VALID, model.NOT_MEASURED)
    ]
    return "&nbsp;&nbsp; ".join(reversed(parts))
