"""The Campaign tab: map, details, lists, progress, and buttons that start commands."""

import math
from collections.abc import Callable, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np
from PyQt5.QtGui import QShowEvent
from PyQt5.QtWidgets import QAction, QWidget

from wavefocus.acquisition.wording import hours
from wavefocus.campaign.sidecar_files import said_path, session_failure
from wavefocus.gui import widgets as ui
from wavefocus.gui.campaign.follower import Follower, same_file
from wavefocus.gui.campaign.model import NOT_GOOD, CampaignModel, Extra
from wavefocus.gui.campaign.panels import Controls, EventList, MapPanel, ProgressRow
from wavefocus.gui.campaign.position_panel import PositionPanel
from wavefocus.gui.files import FileKind, PathField, file_state, names_virtual_rig, rig_of_run
from wavefocus.gui.process import CommandProcess
from wavefocus.gui.surface import VIRTUAL, PlotSurface, plan_surface
from wavefocus.gui.tab import ClosingQuestion, OwnCommand, Tab, TabContext
from wavefocus.storage.errors import InputError


class _CampaignRun(OwnCommand):
    """At most one capture of this window, and one order at a time.

    bank: Bank of that capture.
    foreign: Another process that has the instruments, as of `held`.
    """

    def __init__(self, context: TabContext, owner: QWidget) -> None:
        super().__init__(context)
        self.bank = Path()
        self.foreign = ""
        self.accept_calibration = QAction("Accept another &calibration", owner)
        self.accept_calibration.setCheckable(True)
        self.accept_calibration.setToolTip("Continue the next session with another calibration or other devices")

    def start(self, arguments: Sequence[str], bank: Path, *, virtual: bool = False) -> None:
        """Start a capture, unless one of this window is running."""
        if self.own is not None:
            self._context.messages.warn(f"this window's capture of {self.bank} is still running; stop it first")
            return
        accepted = ["--accept-calibration"] if self.accept_calibration.isChecked() else []
        self.accept_calibration.setChecked(False)
        self.bank = bank
        again = partial(self.start, [*arguments, *accepted, "--accept-drift"], bank, virtual=virtual)
        self.run(
            [*arguments, *accepted],
            partial(self._ended, datetime.now().astimezone(), again),
            holds="" if virtual else f"a run of this window measures {bank}",
            log_file=said_path(bank),
            name="the capture",
            advice="Resume continues from what is in the bank",
        )

    def order(self, word: str, bank: Path | None, done: Callable[[], object] = lambda: None) -> None:
        """Send an order to the process that owns the bank; `done` is called when it was received."""

        def answered(process: CommandProcess) -> None:
            self._context.report_end(process, process.last_line, f"{word}: the answer is not waited for")
            if process.exit_code == 0:
                done()

        if bank is not None:
            order = CommandProcess([word, str(bank), "--json"], self._context.owner, name=word)
            order.finished.connect(lambda: answered(order))
            self._context.messages.warn(f"{word}: waiting for the capture…", ("Stop waiting", order.kill))

    @property
    def held(self) -> str:
        return super().held or self.foreign

    def runs(self, bank: Path | None) -> bool:
        return self.own is not None and bank is not None and same_file(self.bank, bank)

    def closing_question(self) -> ClosingQuestion | None:
        bank = self.bank
        sentence = f"{bank.name} is being measured by a run of this window. What should it do when the window closes?"
        answers = (
            ("Continue in the background", lambda close: close()),
            ("Pause", partial(self.order, "pause", bank)),
            ("Stop after this position", partial(self.order, "stop", bank)),
        )
        return (sentence, answers) if self.running else None

    def _ended(self, started_at: datetime, again: Callable[[], object], process: CommandProcess) -> None:
        failure, why = session_failure(self.bank, started_at) if process.failure else ("", "")
        answers = [("Continue anyway", again)] if failure == "drift" else []
        if failure == "instrument":
            why = f"{why}; nothing measured is lost: put it right, then press Resume"
        stopped = "stopped; nothing measured is lost, Resume continues"
        self._context.report_end(process, process.last_line or "the capture is done", stopped, why, *answers)


# Findings per tick; the rest of a long log follows with the next ticks, so that the window stays responsive.
_FINDINGS_PER_TICK = 3


class CampaignTab(Tab):
    """Starts, follows, interrupts and repairs a campaign, whichever process measures."""

    title = "Campaign"
    kinds = (FileKind.RUN, FileKind.BANK)

    def __init__(self, context: TabContext) -> None:
        super().__init__(context)
        self.campaign = CampaignModel()
        self.follower: Follower | None = None
        self.run = _CampaignRun(context, self)
        self._run_file: Path | None = None
        self._plan_of: tuple[object, ...] = ()
        self._planned_s = math.nan
        self._shared: PlotSurface | None = None
        self._mismatch = ""
        """Why run file and bank do not belong together."""
        self.run_field = PathField("&Run", ".toml", "run file", context)
        self.bank_field = PathField("&Bank", ".h5", "bank file", context, saves=True)
        self.controls = Controls(
            {
                "start": self._start_run,
                "resume": partial(self._start, "Resume", "resume"),
                "pause": self._pause_or_continue,
                "stop": lambda: self.run.order("stop", self.bank_field.path),
                "selected": self._remeasure_selected,
                "poor": partial(self._start, "Remeasure", "remeasure"),
            }
        )
        self.progress = ProgressRow()
        self.map_panel = MapPanel(self.campaign)
        self.position_panel = PositionPanel(context, self.campaign)
        self.events = EventList(self.campaign, self.map_panel.map.show_position)
        self._lay_out()
        self.run_field.chosen.connect(self._run_chosen)
        self.bank_field.chosen.connect(self.follow)
        self.run.accept_calibration.toggled.connect(lambda _on: self._read_plan())
        for panel in (self.position_panel, self.events):
            self.map_panel.map.shown_changed.connect(panel.show_position)

    def menu_actions(self) -> list[QAction | None]:
        """Actions of the buttons, and what a resume may accept."""
        return [*self.controls.actions_by_name.values(), None, self.run.accept_calibration]

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
                self.context.share(self, FileKind.BANK, bank)
                return
            self.follower.end()
        self.context.settle("campaign")
        self.campaign.forget()
        self.follower = Follower(bank, partial(self.context.report, "campaign"))
        self._read_plan()
        self.context.share(self, FileKind.BANK, bank)

    def poll(self) -> None:
        if self.follower is not None:
            self.follower.change(self.campaign, _FINDINGS_PER_TICK)
        surface = self.campaign.surface
        if surface is not None and surface is not self._shared:
            self.context.share(self, FileKind.BANK, surface.bank)  # that of a capture, once it is there
        self._shared = surface
        owner, real = self.campaign.owner, surface is None or not surface.is_virtual
        measures = f"process {owner.pid} on {owner.host} measures {self.bank_field.path}" if owner and real else ""
        self.run.foreign = measures

    def draw(self) -> None:
        campaign, bank, selected = self.campaign, self.bank_field.path, len(self.map_panel.map.selected)
        own = self.run.own if self.run.runs(bank) else None
        state, owner, surface = campaign.state(starting=own is not None), campaign.owner, campaign.surface
        report = own.last_line if own is not None and state.word in (Extra.STARTING, Extra.PREPARING) else ""
        who = f"process {owner.pid} on {owner.host} owns the bank" if owner else ""
        self.progress.show_state(state, report, who)
        faults = [f"{name.partition(',')[0]}: {word}" for name, word in campaign.instrument_faults.items()]
        self.progress.show_faults([*filter(None, [self._mismatch]), *faults])
        shown = surface or self.map_panel.planned
        measured, total = campaign.measured, 0 if shown is None else shown.positions
        plan = f"planned: {total} positions, {hours(self._planned_s)}" if shown and surface is None else ""
        self.progress.show_progress(measured, total, campaign.session, state, plan)
        startable = self.run_field.path is not None and bank is not None and not self._mismatch
        poor, left = int(((campaign.status & NOT_GOOD) > 0).sum()), total - measured
        self.controls.show_possible(
            state, has_run=startable, has_bank=surface is not None, left=left, selected=selected, poor=poor
        )
        for part in (self.map_panel, self.position_panel, self.events):
            part.draw()

    def use_shared(self, kind: FileKind, path: Path) -> None:
        if kind is FileKind.BANK and self.run.own is None and self.campaign.owner is None:
            self.follow(path)

    def showEvent(self, event: QShowEvent | None) -> None:  # noqa: N802
        """Read the run file again where it was edited."""
        super().showEvent(event)
        self._read_plan()

    def restore_settings(self) -> None:
        run, bank = (self.context.settings.text(f"campaign/{name}") for name in ("run", "bank"))
        if run and Path(run).is_file():
            self.run_field.show_path(Path(run))
            self._run_file = Path(run)
            self._share_run(Path(run))
        if bank and (Path(bank).is_file() or self.run_field.path is not None):
            self.follow(Path(bank))

    def shut_down(self) -> None:
        if self.follower is not None:
            self.follower.end()

    def _lay_out(self) -> None:
        upper = ui.side_by_side((self.map_panel, 700), (self.position_panel, 560))
        both = ui.side_by_side((upper, 470), (self.events, 190), growing=[0], above=True)
        self.remember(upper=upper, map_and_events=both)
        self.remembered |= {"run": self.run_field, "bank": self.bank_field}  # restored where no other file is opened
        files = ui.row((self.run_field, 1), (self.bank_field, 1))
        ui.column(files, self.controls, self.progress, (both, 1), owner=self, margins=ui.PAGE_MARGINS)

    def _run_chosen(self, path: Path) -> None:
        """Use a run; a chosen bank stays, unless it belongs to another run."""
        self._share_run(path)
        former, self._run_file = self._run_file, path
        another = former is not None and not same_file(former, path)
        bank = self.bank_field.path
        if another or bank is None or not bank.exists():
            self.follow(path.parent / "plate.h5")

    def _share_run(self, path: Path) -> None:
        """Show a run and its rig in all tabs, and read its plan."""
        self.context.share(self, FileKind.RUN, path)
        if (rig := rig_of_run(path)) is not None:
            self.context.share(self, FileKind.RIG, rig)
        self._read_plan()

    def _read_plan(self) -> None:
        """Read the campaign of the run file, for the map and the hours, and whether the bank is of it."""
        run, bank = self.run_field.path, self.bank_field.path
        accept = self.run.accept_calibration.isChecked()
        states = [None if path is None else file_state(path) for path in (run, bank)]
        # Once for each state of the run file; a bank that is measured changes all the time.
        now = run, states[0], bank, states[1] is not None, accept
        if run is not None and now != self._plan_of:
            self._plan_of = now
            self.context.background.ask("plan", partial(_planned, run, bank, accept), self._show_plan, self._no_plan)

    def _show_plan(self, planned: tuple[PlotSurface, float, str]) -> None:
        self.context.settle("plan")
        self.map_panel.planned, self._planned_s, self._mismatch = planned

    def _no_plan(self, failure: Exception) -> None:
        self._mismatch, self.map_panel.planned = "", None
        self.map_panel.draw()
        self.context.report_failure(failure, "plan")

    def _start_run(self) -> None:
        run, bank = self.run_field.path, self.bank_field.path
        if run is not None and bank is not None:
            virtual = names_virtual_rig(rig_of_run(run) or VIRTUAL)
            self._claim("Start", ["capture", str(run), "--bank", str(bank)], bank, virtual=virtual)

    def _start(self, word: str, command: str, *options: str) -> None:
        bank, surface = self.bank_field.path, self.campaign.surface
        if bank is not None:
            virtual = surface is not None and surface.is_virtual
            self._claim(word, [command, str(bank), *options], bank, virtual=virtual)

    def _claim(self, word: str, arguments: list[str], bank: Path, *, virtual: bool) -> None:
        def start() -> None:
            if not self.run.running:
                self.context.settings.opened(bank)  # other tabs find it there
                self.follow(bank)
            self.run.start(arguments, bank, virtual=virtual)

        self.context.claim_instruments(word, start, virtual=virtual, but=self.run)

    def _pause_or_continue(self) -> None:
        self.run.order("resume" if self.campaign.state().paused else "pause", self.bank_field.path)

    def _remeasure_selected(self) -> None:
        rows = ",".join(str(row) for row in sorted(self.map_panel.map.selected))
        if rows:
            self._start("Remeasure", "remeasure", "--positions", rows)


def _planned(run: Path, bank: Path | None, accept_calibration: bool) -> tuple[PlotSurface, float, str]:
    """Surface of a run file's campaign, its duration in s, and why a bank is of another one, empty where it is not."""
    from wavefocus.campaign.blueprint import blueprint_from_files  # loads SciPy, and this runs in a thread
    from wavefocus.campaign.session_files import with_bank
    from wavefocus.configuration import check_rows

    blueprint = blueprint_from_files(run)
    rig, plan = blueprint.configuration.rig, blueprint.plan
    surface = plan_surface(rig, plan.position_mm, check_rows(blueprint.configuration))
    mismatch = ""
    if bank is not None and bank.is_file():
        try:
            with_bank(blueprint, bank, run, accept_calibration=accept_calibration)
        except InputError as other:
            mismatch = f"{bank.name} is not of {run.name}: {other}"
    return surface, plan.campaign_s(np.arange(plan.positions), rig.recorder), mismatch
