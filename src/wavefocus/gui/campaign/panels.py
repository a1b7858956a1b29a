"""Panels around the map: buttons, progress, events with a filter, and instruments."""

import math
from collections.abc import Callable, Sequence

from PyQt5.QtCore import QModelIndex, QSortFilterProxyModel, Qt, pyqtSignal
from PyQt5.QtGui import QColor, QStandardItem, QStandardItemModel
from PyQt5.QtWidgets import QAbstractItemView, QAction, QHeaderView, QLineEdit, QTableView, QToolButton, QWidget

from wavefocus.campaign.status import GOING_ON, CampaignStatus
from wavefocus.config.messages.campaign import State
from wavefocus.gui import widgets as ui
from wavefocus.gui.campaign.model import CampaignModel, EventLine, Extra, ShownState, Weight, clock
from wavefocus.gui.theme import Themed

# Name, text, key and tooltip.
_BUTTONS = (
    ("start", "Start", "Ctrl+Return", "Start the campaign of the run file in the bank, or continue it"),
    ("resume", "Resume", "Ctrl+R", "Continue the bank's campaign; the bank alone is enough"),
    ("pause", "Pause", "Ctrl+P", "Finish the current position, then wait, muted and parked"),
    ("stop", "Stop after this position", "Ctrl+T", "Finish the current position and end; Resume continues"),
    ("selected", "Remeasure selected", "Ctrl+M", "Measure the selected positions again (Ctrl-click, Shift-drag)"),
    ("poor", "Remeasure poor", "Ctrl+Shift+M", "Measure again all that is poor, over-range or failed"),
)


#: States in which the second press of Pause continues.
PAUSED = (State.PAUSING, State.PAUSED)


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
            parts += [self.buttons[name], 10 if name == "stop" else 0]
        ui.row(*parts, None, owner=self)

    def show_possible(
        self, state: ShownState, *, has_run: bool, has_bank: bool, left: int, selected: int, poor: int
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
            ("pause", orders, "Continue" if word in PAUSED else "Pause"),
            ("stop", orders or word in (Extra.PREPARING, Extra.SILENT), "Stop after this position"),
            ("selected", free and has_bank and selected > 0, f"Remeasure selected{f' ({selected})' * (selected > 0)}"),
            ("poor", free and has_bank and poor > 0, f"Remeasure poor{f' ({poor})' * (poor > 0)}"),
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
        self.faults = ui.label("Lasting faults", wraps=True, selectable=True)
        self.faults.setStyleSheet(f"color: {self.theme.fault};")
        row = ui.row(self.state, (self.reason, 3), (self.bar, 3), self.figures, spacing=10)
        ui.column(row, self.faults, owner=self)

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
        reason = report or state.reason
        self.reason.setText(reason)
        self.reason.setToolTip(f"{reason}\n{owner}".strip())

    def show_faults(self, faults: Sequence[str]) -> None:
        """Show what is wrong and stays so: instruments whose last word is a fault, a bank of another run."""
        self.faults.setText("\n".join(f"▲ {fault}" for fault in faults))
        self.faults.setVisible(bool(faults))

    def show_progress(self, measured: int, total: int, session: CampaignStatus, state: ShownState, plan: str) -> None:
        """Show the progress of the bank, or of the session while it runs and has measured a position; else a plan."""
        paced = state.measuring and session.progress is not None
        done, of = (session.done, session.total) if paced else (measured, total)
        self.bar.setTextVisible(of > 0)  # without a bank and a plan there is nothing to count
        self.bar.setMaximum(max(of, 1))
        self.bar.setValue(done)
        self.figures.setText(pace_text(session, going_on=state.going_on) if paced else plan)


def pace_text(session: CampaignStatus, *, going_on: bool) -> str:
    """Rate and finish of a session; the finish only while it is going on, for a pause may last."""
    progress, at = session.progress, session.progress_at
    if progress is None or at is None:
        return ""
    parts = [] if math.isnan(progress.per_hour) else [f"{progress.per_hour:.0f} positions an hour"]
    if going_on and not math.isnan(progress.wall_remaining_s):
        parts.append(ui.finish_text(at.timestamp() + progress.wall_remaining_s))
    return "  ·  ".join(parts)


class _EventFilter(QSortFilterProxyModel):
    """Lines that `accepts` is true of."""

    def __init__(self, events: QStandardItemModel) -> None:
        super().__init__()
        self.accepts: Callable[[EventLine], bool] = lambda _line: True
        self._events = events
        self.setSourceModel(events)

    def filterAcceptsRow(self, row: int, _parent: QModelIndex) -> bool:  # noqa: N802
        return self.accepts(_line_of(self._events.index(row, 0)))


def _line_of(index: QModelIndex) -> EventLine:
    line = index.siblingAtColumn(0).data(Qt.ItemDataRole.UserRole)
    assert isinstance(line, EventLine)
    return line


def _items(line: EventLine) -> list[QStandardItem]:
    """A row of the table; its first item holds the line itself."""
    colours = {Weight.FAULT: Themed.theme.fault, Weight.WARNING: Themed.theme.warning}
    items = [QStandardItem(text) for text in (clock(line.at_s), line.weight.name.lower(), line.text)]
    for item in items:
        item.setEditable(False)
        item.setToolTip(item.text())
        if line.weight in colours:
            item.setForeground(QColor(colours[line.weight]))
    items[0].setData(line, Qt.ItemDataRole.UserRole)
    return items


class EventList(Themed, QWidget):
    """Events; a double click shows the position concerned."""

    position_wanted = pyqtSignal(int)

    def __init__(self, campaign: CampaignModel) -> None:
        super().__init__()
        self._campaign = campaign
        self._drawn = self._position = -1
        self._trimmed = campaign.trimmed
        self._table = QStandardItemModel()
        self._table.setHorizontalHeaderLabels(["time", "weight", "event"])
        self.lines = _EventFilter(self._table)
        choices = ["everything", "notes and above", "warnings and faults", "faults"]
        tip = "Events shown here (all are in the log next to the bank)"
        self.weight = ui.choice("Least weight", tip, choices, Weight.NOTE)
        self.text = ui.named(QLineEdit(), "Show only events that contain this text (Ctrl+F)", "Filter text")
        self.text.setPlaceholderText("filter…")
        self.text.setClearButtonEnabled(True)
        self.of_position = ui.check("this position", "Show only events of the position that is shown above")
        self.view = QTableView()
        self.view.setModel(self.lines)
        self.view.setAccessibleName("Events")
        self.view.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.view.setShowGrid(False)
        self.view.setTabKeyNavigation(False)
        self.view.setWordWrap(False)
        rows, columns, metrics = self.view.verticalHeader(), self.view.horizontalHeader(), self.fontMetrics()
        assert rows is not None
        assert columns is not None
        rows.hide()
        rows.setSectionResizeMode(QHeaderView.ResizeMode.Fixed)
        rows.setDefaultSectionSize(metrics.height() + 5)
        columns.setStretchLastSection(True)
        self.view.setColumnWidth(0, metrics.horizontalAdvance("Wed 00:00:00") + 18)
        self.view.setColumnWidth(1, metrics.horizontalAdvance("warning") + 22)
        title = ui.label(text="Events", role="strong")
        filters = ui.row(title, self.weight, self.of_position, (self.text, 1))
        ui.column(filters, (self.view, 1), owner=self)
        for changed in (self.weight.currentIndexChanged, self.text.textChanged, self.of_position.toggled):
            changed.connect(self._restrict)
        self._restrict()
        self.view.doubleClicked.connect(self._want_position)

    def draw(self) -> None:
        if self._drawn != self._campaign.revision["lines"]:
            self._drawn = self._campaign.revision["lines"]
            bar = self.view.verticalScrollBar()
            at_end = bar is None or bar.value() >= bar.maximum() - 1
            self._table.removeRows(0, min(self._campaign.trimmed - self._trimmed, self._table.rowCount()))
            self._trimmed = self._campaign.trimmed
            for line in self._campaign.lines[self._table.rowCount() :]:
                self._table.appendRow(_items(line))
            if at_end:
                self.view.scrollToBottom()

    def show_position(self, position: int) -> None:
        """Note the position that "this position" means; -1 for none."""
        self._position = position
        if self.of_position.isChecked():
            self._restrict()

    def _restrict(self) -> None:
        least, text = self.weight.currentIndex(), self.text.text().casefold()
        position = self._position if self.of_position.isChecked() else -1
        self.lines.accepts = lambda line: (
            line.weight >= least and position in (-1, line.position) and text in line.text.casefold()
        )
        self.lines.invalidateFilter()
        self.view.scrollToBottom()

    def _want_position(self, index: QModelIndex) -> None:
        if (position := _line_of(index).position) >= 0:
            self.position_wanted.emit(position)
