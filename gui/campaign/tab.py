"""The Campaign tab: map, details, lists, progress, and buttons that start commands."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QAction, QProgressBar, QToolButton, QWidget

from config.messages.campaign import State
from gui.campaign.follower import Follower, same_file
from gui.campaign.lists import EventList, InstrumentList
from gui.campaign.map_panel import MapPanel
from gui.campaign.model import GOING, Campaign, CampaignState, Extra, Order, Pace, possible_orders
from gui.campaign.position_panel import PositionPanel
from gui.campaign.quality import NOT_GOOD
from gui.campaign.run import CampaignRun
from gui.files import PathField
from gui.tab import Question, Tab, TabContext
from gui.theme import LIGHT, Theme
from gui.toml_files import TomlKind, runs_on_virtual_rig, toml_kind
from gui.widgets import (
    PAGE_MARGINS,
    Badge,
    column,
    copy_text,
    finish_text,
    make_action,
    make_button,
    make_label,
    put,
    row,
    side_by_side,
    stacked,
)
from rendering.verify.record import FIELD_NAMES, RECORD_NAME

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

    Parameters
    ----------
    acts : dict of callable
        Action of each button.
    """

    def __init__(self, acts: dict[str, Callable[[], object]]) -> None:
        super().__init__()
        self.actions_by_name: dict[str, QAction] = {}
        self.buttons: dict[str, QToolButton] = {}
        parts: list[QWidget | int | None] = []
        for name, text, key, tip in _BUTTONS:
            action = self.actions_by_name[name] = make_action(self, text, acts[name], key, tip=tip)
            action.setEnabled(False)
            self.buttons[name] = make_button(action)
            parts += [self.buttons[name], 10 if name in ("plan", "stop") else 0]
        row(*parts, None, owner=self)

    def show_possible(self, orders: frozenset[Order], *, has_run: bool, selected: int, poor: int) -> None:
        """Enable what makes sense, and show how many positions would be measured again."""
        paused = Order.CONTINUE in orders
        for name, enabled in (
            ("plan", has_run),
            ("start", Order.START in orders),
            ("resume", Order.RESUME in orders),
            ("pause", paused or Order.PAUSE in orders),
            ("stop", Order.STOP in orders),
            ("selected", Order.REMEASURE in orders and selected > 0),
            ("poor", Order.REMEASURE in orders and poor > 0),
        ):
            self.actions_by_name[name].setEnabled(enabled)
        for name, text in (
            ("pause", "Continue" if paused else "Pause"),
            ("selected", f"Remeasure selected ({selected})" if selected else "Remeasure selected"),
            ("poor", f"Remeasure poor ({poor})" if poor else "Remeasure poor"),
        ):
            if self.actions_by_name[name].text() != text:
                self.actions_by_name[name].setText(text)
                self.buttons[name].setAccessibleName(text)


class ProgressRow(QWidget):
    """State, reason, progress bar and figures above the map."""

    def __init__(self) -> None:
        super().__init__()
        self._theme = LIGHT
        self.state = Badge("State of the campaign")
        self.reason = make_label("Reason of the state", any_width=True)
        self.bar = QProgressBar()
        self.bar.setAccessibleName("Progress of the campaign")
        self.bar.setFormat("%v of %m positions (%p %)")
        self.figures = make_label("Rate, remaining time and finish time")
        row(self.state, (self.reason, 3), (self.bar, 3), self.figures, owner=self).setSpacing(10)

    def show_state(self, state: CampaignState, report: str, owner: str) -> None:
        """Show a state and its reason; `report` of the capture replaces the reason while it has none."""
        theme, word = self._theme, state.word
        colour = (
            theme.fault if word in (State.FAILED, Extra.GONE, Extra.SILENT)
            else theme.warning if word in GOING and word is not State.RUNNING
            else theme.good if state.measuring or word is State.FINISHED
            else theme.faint
        )  # fmt: skip
        self.state.show_word(str(word), colour)
        put(self.reason, report or state.reason)
        self.reason.setToolTip(f"{report or state.reason}\n{owner}".strip())

    def show_progress(self, measured: int, total: int, pace: Pace | None, *, measuring: bool) -> None:
        """Show the progress of the session while it runs, else of the bank."""
        done, of = (pace.done, pace.total) if measuring and pace is not None else (measured, total)
        if (self.bar.value(), self.bar.maximum()) != (done, max(of, 1)):
            self.bar.setMaximum(max(of, 1))
            self.bar.setValue(done)
        put(self.figures, _pace_text(pace) if measuring and pace is not None else "")

    def apply_theme(self, theme: Theme) -> None:
        self._theme = theme
        self.state.apply_theme(theme)


def _pace_text(pace: Pace) -> str:
    text = f"{pace.per_hour:.0f} positions an hour" if not math.isnan(pace.per_hour) else ""
    return text if math.isnan(pace.finish_s) else f"{text}  ·  {finish_text(pace.finish_s)}"


# Findings per tick; the rest of a long log follows with the next ticks, so that the window stays responsive.
_FINDINGS_PER_TICK = 3
_DEFAULT_BANK = "plate.h5"
# Without news, clocks and buttons are drawn this often.
_CLOCKS_EVERY_S = 0.25


class CampaignTab(Tab):
    """Starts, follows, interrupts and repairs a campaign, whichever process measures."""

    title = "Campaign"
    opens = (".h5", ".toml")

    def __init__(self, context: TabContext) -> None:
        super().__init__(context)
        self.campaign = Campaign()
        self.follower: Follower | None = None
        self.run = CampaignRun(context, self)
        self._trouble = ""
        self._paused = False
        self._run_file: Path | None = None
        self._drawn: tuple[int, ...] = ()
        self._draw_due_s = 0.0
        self.run_field = PathField("&Run", ".toml", "run file", context.settings)
        self.bank_field = PathField("&Bank", ".h5", "bank file", context.settings, saves=True)
        self.controls = Controls(
            {
                "plan": self._plan,
                "start": self._start_run,
                "resume": lambda: self._start("Resume", "resume"),
                "pause": self._pause_or_continue,
                "stop": lambda: self.run.order("stop", self.bank_field.path),
                "selected": self._remeasure_selected,
                "poor": lambda: self._start("Remeasure", "remeasure"),
            }
        )
        self.progress = ProgressRow()
        self.map_panel = MapPanel(self.campaign)
        self.position_panel = PositionPanel(context, self.campaign)
        self.events = EventList(self.campaign)
        self.instruments = InstrumentList(self.campaign)
        self._lay_out()
        self.run_field.chosen.connect(self._run_chosen)
        self.bank_field.chosen.connect(self._bank_chosen)
        self.map_panel.map.shown_changed.connect(self.position_panel.show_position)
        self.events.position_wanted.connect(self.map_panel.map.show_position)
        self.map_panel.map.selection_changed.connect(self._share_selection)

    def menu_actions(self) -> list[QAction | None]:
        """Actions of the buttons, and what a resume may accept."""
        seek = partial(self.events.text.setFocus, Qt.FocusReason.ShortcutFocusReason)
        find = make_action(self, "&Find in events", seek, "Ctrl+F")
        return [*self.controls.actions_by_name.values(), None, self.run.accept_drift, self.run.accept_calibration,
                None, find]  # fmt: skip

    def accepts(self, path: Path) -> bool:
        """Banks, and TOML files that are neither rigs nor scenes; not the files of a verification."""
        name = path.name.lower()
        if name.endswith(".toml"):
            return toml_kind(path) in (TomlKind.RUN, TomlKind.UNREADABLE)  # the capture reports what is wrong with it
        of_verification = path.name in FIELD_NAMES and path.with_name(RECORD_NAME).exists()
        return name.endswith(".h5") and not name.endswith(".raw.h5") and not of_verification

    def open_file(self, path: Path) -> None:
        if path.suffix.lower() == ".toml":
            self.run_field.show_path(path)
            self._run_chosen(path)
        else:
            self.follow(path)

    def follow(self, bank: Path) -> None:
        """Follow a bank, read-only."""
        self.bank_field.show_path(bank)
        if self.follower is not None:
            if same_file(self.follower.bank, bank):
                return
            self.follower.end()
        self._show_trouble("")
        self.campaign.forget()
        self.map_panel.map.show_surface(None)
        self.follower = Follower(bank, self.context.front)

    def poll(self) -> None:
        if self.follower is not None:
            for seen in self.follower.take(_FINDINGS_PER_TICK):
                self.campaign.take(seen)
        trouble = self.campaign.trouble
        if trouble.sentence != self._trouble:
            self._show_trouble(trouble.sentence, trouble.details)

    def draw(self) -> None:
        campaign, bank, selected = self.campaign, self.bank_field.path, len(self.map_panel.map.selected)
        news = (*campaign.revision.values(), selected)
        if news == self._drawn and time.monotonic() < self._draw_due_s:
            return
        self._drawn, self._draw_due_s = news, time.monotonic() + _CLOCKS_EVERY_S
        state, owner, has_run = (
            campaign.state(starting=self.run.runs(bank)),
            campaign.owner,
            self.run_field.path is not None,
        )
        report = self.run.last_line(bank) if state.word in (Extra.STARTING, Extra.PREPARING) else ""
        who = f"process {owner.pid} on {owner.host} owns the bank" if owner else ""
        self.progress.show_state(state, report, who)
        total = campaign.surface.positions if campaign.surface else 0
        self.progress.show_progress(campaign.measured, total, campaign.pace, measuring=state.measuring)
        orders = possible_orders(
            state,
            has_run=has_run and bank is not None,
            has_bank=campaign.surface is not None,
            left=total - campaign.measured,
        )
        self._paused = Order.CONTINUE in orders
        poor = int(((campaign.status & NOT_GOOD) > 0).sum())
        self.controls.show_possible(orders, has_run=has_run, selected=selected, poor=poor)
        for part in (self.map_panel, self.position_panel, self.events, self.instruments):
            part.draw()

    def apply_theme(self, theme: Theme) -> None:
        for part in (self.progress, self.map_panel, self.position_panel, self.events, self.instruments):
            part.apply_theme(theme)

    def run_file(self) -> Path | None:
        return self.run_field.path

    def instruments_held(self) -> str:
        owner, surface = self.campaign.owner, self.campaign.surface
        if owner is not None and not (surface is not None and surface.is_virtual):
            return f"process {owner.pid} on {owner.host} measures {self.bank_field.path}"
        return self.run.instruments_held()

    def closing_question(self) -> Question | None:
        return self.run.closing_question()

    def save_settings(self) -> None:
        super().save_settings()
        for name, field in (("run", self.run_field), ("bank", self.bank_field)):
            self.context.settings.keep(f"campaign/{name}", str(field.path or ""))

    def restore_settings(self) -> None:
        run, bank = (self.context.settings.text(f"campaign/{name}") for name in ("run", "bank"))
        if run and Path(run).is_file():
            self.run_field.show_path(Path(run))
            self._run_file = Path(run)
        if bank and (Path(bank).is_file() or self.run_field.path is not None):
            self.follow(Path(bank))

    def shut_down(self) -> None:
        if self.follower is not None:
            self.follower.end()
        self.run.detach()

    def _lay_out(self) -> None:
        upper = side_by_side((self.map_panel, 700), (self.position_panel, 560))
        lower = side_by_side((self.instruments, 480), (self.events, 780))
        both = stacked((upper, 470), (lower, 190), growing=[0])
        self.divide(upper=upper, lower=lower, both=both)
        files = row((self.run_field, 1), (self.bank_field, 1))
        column(files, self.controls, self.progress, (both, 1), owner=self, margins=PAGE_MARGINS)

    def _run_chosen(self, path: Path) -> None:
        """Use a run; a chosen bank stays, unless it belongs to another run."""
        self.context.settings.opened(path)
        former, self._run_file = self._run_file, path
        another = former is not None and not same_file(former, path)
        bank = self.bank_field.path
        if another or bank is None or not bank.exists():
            self.follow(path.parent / _DEFAULT_BANK)

    def _bank_chosen(self, path: Path) -> None:
        self.context.settings.opened(path)
        self.follow(path)

    def _plan(self) -> None:
        if self.run_field.path is not None:
            self.run.plan(self.run_field.path)

    def _start_run(self) -> None:
        run, bank = self.run_field.path, self.bank_field.path
        if run is not None and bank is not None:
            self._claim("Start", ["capture", str(run), "--bank", str(bank)], bank, virtual=runs_on_virtual_rig(run))

    def _start(self, word: str, command: str, *options: str) -> None:
        bank, surface = self.bank_field.path, self.campaign.surface
        if bank is not None:
            virtual = surface is not None and surface.is_virtual
            self._claim(word, [command, str(bank), *options], bank, virtual=virtual)

    def _claim(self, word: str, arguments: list[str], bank: Path, *, virtual: bool) -> None:
        def start() -> None:
            self.context.settings.opened(bank)  # other tabs find it there
            self.follow(bank)
            self.run.start(arguments, bank, virtual=virtual)

        self.context.claim_instruments(self, word, start, virtual=virtual)

    def _pause_or_continue(self) -> None:
        self.run.order("go-on" if self._paused else "pause", self.bank_field.path)

    def _show_trouble(self, sentence: str, details: str = "") -> None:
        self.context.messages.withdraw(self._trouble)
        self._trouble = sentence
        if sentence:
            answers = [("Copy details", lambda: copy_text(details))] if details else []
            self.context.messages.fault(sentence, *answers)

    def _share_selection(self) -> None:
        self.context.selection.bank = self.bank_field.path
        self.context.selection.rows = frozenset(self.map_panel.map.selected)

    def _remeasure_selected(self) -> None:
        rows = ",".join(str(row) for row in sorted(self.map_panel.map.selected))
        if rows:
            self._start("Remeasure", "remeasure", "--positions", rows)
