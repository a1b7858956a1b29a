"""Panels around the map: buttons, progress, events with a filter, and instruments."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from PyQt5.QtCore import QAbstractTableModel, QModelIndex, Qt, pyqtSignal
from PyQt5.QtGui import QColor
from PyQt5.QtWidgets import QAbstractItemView, QAction, QHeaderView, QLineEdit, QTableView, QToolButton, QWidget

from wavefocus.acquisition.wording import hours
from wavefocus.campaign.status import GOING_ON, CampaignStatus
from wavefocus.config.messages.campaign import State
from wavefocus.gui import widgets as ui
from wavefocus.gui.advice import in_window
from wavefocus.gui.campaign.model import CampaignAction, CampaignModel, EventLine, Extra, ShownState, Weight, clock
from wavefocus.gui.theme import Themed

# Name, text, key and tooltip.
_BUTTONS = (
    ("plan", "Dry run", "Ctrl+D", "Walk the run file's plan without playing: positions, hours, bytes"),
    ("start", "Start", "Ctrl+Return", "Start the campaign of the run file in the bank, or continue it"),
    ("resume", "Resume", "Ctrl+R", "Continue the bank's campaign; the bank alone is enough"),
    ("pause", "Pause", "Ctrl+P", "Finish the current position, then wait, muted and parked"),
    ("stop", "Stop after this position", "Ctrl+T", "Finish the current position and end; Resume continues"),
    ("selected", "Remeasure selected", "Ctrl+M", "Measure the selected positions again (Ctrl-click, Shift-drag)"),
    ("poor", "Remeasure poor", "Ctrl+Shift+M", "Measure again all that is poor, over-range or failed"),
)


class Controls(QWidget):
    """Row of buttons; `actions_by_name` are in the menu, too.

    acts: Action of each button.
    """

    def __init__(self, acts: dict[str, Callable[[], object]]) -> None:
        super().__init__()
        self.actions_by_name: dict[str, QAction] = {}
        self.buttons: dict[str, QToolButton] = {}
        parts: list[QWidget | int | None] = []
        for name, text, key, tip in _BUTTONS:
            action = self.actions_by_name[name] = ui.action(self, text, acts[name], key, tip=tip)
            action.setEnabled(False)
            self.buttons[name] = ui.button(action)
            parts += [self.buttons[name], 10 if name in ("plan", "stop") else 0]
        ui.row(*parts, None, owner=self)

    def show_possible(self, orders: frozenset[CampaignAction], *, has_run: bool, selected: int, poor: int) -> None:
        """Enable what makes sense, and show how many positions would be measured again."""
        paused, remeasures = CampaignAction.CONTINUE in orders, CampaignAction.REMEASURE in orders
        for name, enabled, text in (
            ("plan", has_run, "Dry run"),
            ("start", CampaignAction.START in orders, "Start"),
            ("resume", CampaignAction.RESUME in orders, "Resume"),
            ("pause", paused or CampaignAction.PAUSE in orders, "Continue" if paused else "Pause"),
            ("stop", CampaignAction.STOP in orders, "Stop after this position"),
            ("selected", remeasures and selected > 0, f"Remeasure selected{f' ({selected})' if selected else ''}"),
            ("poor", remeasures and poor > 0, f"Remeasure poor{f' ({poor})' if poor else ''}"),
        ):
            self.actions_by_name[name].setEnabled(enabled)
            if self.actions_by_name[name].text() != text:
                self.actions_by_name[name].setText(text)
                self.buttons[name].setAccessibleName(text)


class ProgressRow(Themed, QWidget):
    """State, reason, progress bar and figures above the map."""

    def __init__(self) -> None:
        super().__init__()
        self.state = ui.Badge("State of the campaign")
        self.reason = ui.label("Reason of the state", any_width=True)
        self.bar = ui.progress_bar("Progress of the campaign", "%v of %m positions (%p %)")
        self.figures = ui.label("Rate, remaining time and finish time")
        ui.row(self.state, (self.reason, 3), (self.bar, 3), self.figures, owner=self, spacing=10)

    def show_state(self, state: ShownState, report: str, owner: str) -> None:
        """Show a state and its reason; `report` of the capture replaces the reason while it has none."""
        theme, word = self.theme, state.word
        colour = (
            theme.fault if word in (State.FAILED, Extra.GONE, Extra.SILENT)
            else theme.warning if word in GOING_ON and word is not State.RUNNING
            else theme.good if state.measuring or word is State.FINISHED
            else theme.faint
        )  # fmt: skip
        self.state.show_word(str(word), colour)
        reason = in_window(report or state.reason)
        ui.put(self.reason, reason)
        self.reason.setToolTip(f"{reason}\n{owner}".strip())

    def show_progress(self, measured: int, total: int, session: CampaignStatus, state: ShownState) -> None:
        """Show the progress of the bank, or of the session while it runs and has measured a position."""
        paced = state.measuring and session.progress is not None
        done, of = (session.done, session.total) if paced else (measured, total)
        self.bar.setTextVisible(of > 0)  # without a bank and a plan there is nothing to count
        if (self.bar.value(), self.bar.maximum()) != (done, max(of, 1)):
            self.bar.setMaximum(max(of, 1))
            self.bar.setValue(done)
        ui.put(self.figures, pace_text(session, going_on=state.going_on) if paced else "")

    def show_plan(self, positions: int, duration_s: float) -> None:
        """Show what the run file plans; nothing is measured yet."""
        self.show_progress(0, positions, CampaignStatus(), ShownState(Extra.NO_BANK))
        ui.put(self.figures, f"planned: {positions} positions, {hours(duration_s)}")


def pace_text(session: CampaignStatus, *, going_on: bool) -> str:
    """Rate and finish of a session; the finish only while it is going on, for a pause may last."""
    progress, at = session.progress, session.progress_at
    if progress is None or at is None:
        return ""
    parts = [] if math.isnan(progress.per_hour) else [f"{progress.per_hour:.0f} positions an hour"]
    if going_on and not math.isnan(progress.wall_remaining_s):
        parts.append(ui.finish_text(at.timestamp() + progress.wall_remaining_s))
    return "  ·  ".join(parts)


_TITLES = ("time", "weight", "event")
_NOWHERE = QModelIndex()
_COUNT_EVERY_S = 0.5
_STATE_MARKS = {"in use": "●", "at rest": "○", "faulty": "▲", "away": "✕"}


class EventTable(QAbstractTableModel):
    """Lines that pass the filter."""

    def __init__(self, campaign: CampaignModel) -> None:
        super().__init__()
        self._campaign = campaign
        self.shown: list[EventLine] = []
        self._taken = self._trimmed = 0
        self._least = Weight.NOTE
        self._text = ""

    def rowCount(self, parent: QModelIndex = _NOWHERE) -> int:  # noqa: N802
        return 0 if parent.isValid() else len(self.shown)

    def columnCount(self, parent: QModelIndex = _NOWHERE) -> int:  # noqa: N802
        return 0 if parent.isValid() else len(_TITLES)

    def data(self, index: QModelIndex, role: int = Qt.ItemDataRole.DisplayRole) -> object:
        if not index.isValid():
            return None
        line = self.shown[index.row()]
        if role in (Qt.ItemDataRole.DisplayRole, Qt.ItemDataRole.ToolTipRole):
            return (clock(line.at_s), line.weight.name.lower(), line.text)[index.column()]
        if role == Qt.ItemDataRole.ForegroundRole and line.weight >= Weight.WARNING:
            return QColor(Themed.theme.fault if line.weight is Weight.FAULT else Themed.theme.warning)
        return None

    def headerData(  # noqa: N802
        self, section: int, orientation: Qt.Orientation, role: int = Qt.ItemDataRole.DisplayRole
    ) -> object:
        wanted = orientation == Qt.Orientation.Horizontal and role == Qt.ItemDataRole.DisplayRole
        return _TITLES[section] if wanted else None

    def restrict(self, least: Weight, text: str) -> None:
        """Show only lines of at least some weight that contain a text."""
        self._least, self._text = least, text.casefold()
        self._rebuild()

    def take_new(self) -> bool:
        """Add new lines; whether any of them is shown."""
        lines = self._campaign.lines
        if self._trimmed != self._campaign.trimmed:
            self._rebuild()
            return True
        new = [line for line in lines[self._taken :] if self._passes(line)]
        self._taken = len(lines)
        if new:
            self.beginInsertRows(QModelIndex(), len(self.shown), len(self.shown) + len(new) - 1)
            self.shown.extend(new)
            self.endInsertRows()
        return bool(new)

    def _rebuild(self) -> None:
        self.beginResetModel()
        self.shown = [line for line in self._campaign.lines if self._passes(line)]
        self._taken, self._trimmed = len(self._campaign.lines), self._campaign.trimmed
        self.endResetModel()

    def _passes(self, line: EventLine) -> bool:
        return line.weight >= self._least and (not self._text or self._text in line.text.casefold())


class EventList(Themed, QWidget):
    """Events; a double click shows the position concerned."""

    position_wanted = pyqtSignal(int)

    def __init__(self, campaign: CampaignModel) -> None:
        super().__init__()
        self._campaign = campaign
        self._drawn = -1
        self._count_due_s = 0.0
        self.lines = EventTable(campaign)
        choices = ["everything", "notes and above", "warnings and faults", "faults"]
        tip = "Events shown here (all are in the log next to the bank)"
        self.weight = ui.choice("Least weight", tip, choices, Weight.NOTE)
        self.text = ui.named(QLineEdit(), "Show only events that contain this text (Ctrl+F)", "Filter text")
        self.text.setPlaceholderText("filter…")
        self.text.setClearButtonEnabled(True)
        self.view = QTableView()
        self.view.setModel(self.lines)
        self.view.setAccessibleName("Events")
        self.view.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.view.setShowGrid(False)
        self.view.setWordWrap(False)
        rows, columns = self.view.verticalHeader(), self.view.horizontalHeader()
        assert rows is not None
        assert columns is not None
        rows.hide()
        rows.setSectionResizeMode(QHeaderView.ResizeMode.Fixed)
        columns.setStretchLastSection(True)
        self._rows = rows
        self._count = ui.label(role="faint")
        title = ui.label(text="Events", role="strong")
        ui.column(ui.row(title, self.weight, (self.text, 1), self._count), (self.view, 1), owner=self)
        self.weight.currentIndexChanged.connect(self._restrict)
        self.text.textChanged.connect(self._restrict)
        self.view.doubleClicked.connect(self._show_position)

    def draw(self) -> None:
        if self._drawn != self._campaign.revision["lines"]:
            self._drawn = self._campaign.revision["lines"]
            bar = self.view.verticalScrollBar()
            at_end = bar is None or bar.value() >= bar.maximum() - 1
            if self.lines.take_new() and at_end:
                self.view.scrollToBottom()
        if time.monotonic() >= self._count_due_s:
            self._show_count()

    def redraw(self) -> None:
        """Use the size of the text, too."""
        metrics = self.fontMetrics()
        self._rows.setDefaultSectionSize(metrics.height() + 5)
        self.view.setColumnWidth(0, metrics.horizontalAdvance("Wed 00:00:00") + 18)
        self.view.setColumnWidth(1, metrics.horizontalAdvance("warning") + 22)
        self._count.setMinimumWidth(metrics.horizontalAdvance("0000 of 00000"))

    def _restrict(self) -> None:
        self.lines.restrict(Weight(self.weight.currentIndex()), self.text.text())
        self._show_count()
        self.view.scrollToBottom()

    def _show_count(self) -> None:
        """Show the number of lines; not at every event, because a label that changes lays out its row again."""
        self._count_due_s = time.monotonic() + _COUNT_EVERY_S
        self._count.setText(f"{self.lines.rowCount()} of {len(self._campaign.lines)}")

    def _show_position(self, index: QModelIndex) -> None:
        position = self.lines.shown[index.row()].position
        if position >= 0:
            self.position_wanted.emit(position)


class InstrumentList(Themed, QWidget):
    """State and last message of each instrument."""

    def __init__(self, campaign: CampaignModel) -> None:
        super().__init__()
        self._campaign = campaign
        self._drawn = -1
        self.table = ui.table(("instrument", "state", "last message"), "Instruments", stretched=(2,))
        self.table.setWordWrap(False)
        ui.column(ui.label(text="Instruments", role="strong"), (self.table, 1), owner=self)

    def draw(self) -> None:
        if self._drawn == self._campaign.revision["instruments"]:
            return
        self._drawn = self._campaign.revision["instruments"]
        instruments, theme = self._campaign.instruments, self.theme
        self.table.setRowCount(len(instruments))
        colours = {"in use": theme.good, "at rest": theme.faint, "faulty": theme.warning, "away": theme.fault}
        for number, instrument in enumerate(instruments):
            message = f"{clock(instrument.at_s)}  {instrument.message}".strip()
            state = f"{_STATE_MARKS[instrument.state]} {instrument.state}"
            ui.fill_row(self.table, number, (instrument.name, state, message or "-"), {1: colours[instrument.state]})
            name = self.table.item(number, 0)
            assert name is not None
            name.setText(instrument.name.partition(",")[0])

    def redraw(self) -> None:
        self._drawn = -1
