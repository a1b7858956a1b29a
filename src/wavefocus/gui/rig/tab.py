"""The Rig tab: examine a rig, operate it by hand, calibrate it; each in a separate process of the command."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from PyQt5.QtWidgets import QAction, QToolButton, QWidget

from wavefocus.config.loading import read_toml, validated
from wavefocus.config.messages import from_record
from wavefocus.config.messages.rig_checks import Finding, FindingMade
from wavefocus.config.rig import RigConfig, Surface
from wavefocus.gui import widgets as ui
from wavefocus.gui.files import FileKind, PathField, names_virtual_rig
from wavefocus.gui.process import CommandProcess, Message
from wavefocus.gui.rig.calibration_page import CalibrationPage
from wavefocus.gui.rig.manual_page import ManualPage
from wavefocus.gui.rig.session import Calibration, ManualSession
from wavefocus.gui.tab import OwnCommand, Tab, TabContext
from wavefocus.gui.theme import Themed
from wavefocus.storage.errors import InputError

_HEADINGS = ("verdict", "instrument", "check", "finding", "remedy", "")
# Mark and word of a verdict, and its word in the summary.
_VERDICTS = {
    "fail": ("✖ fail", "not good enough"),
    "warn": ("▲ look", "to look at"),
    "skipped": ("– skipped", "skipped"),
    "ok": ("✔ ok", "ok"),
}


def button_of(finding: Finding) -> tuple[str, str] | None:
    """Action and text of a finding's button; None where there is nothing to do in the window."""
    if finding.act is not None and finding.act.do == "calibrate":
        return "calibrate", f"Calibrate {finding.act.on}…".replace(" …", "…")
    return ("again", "Check again") if finding.verdict in ("fail", "warn") else None


def remedy_of(finding: Finding) -> str:
    """What to do about a finding: the button to press, or the remedy with the key of the rig file that it is about."""
    button, act = button_of(finding), finding.act
    if button is not None and button[0] == "calibrate":
        return f"press {button[1]}"
    if act is not None and act.do == "edit-rig" and act.on not in finding.remedy:
        return f"{finding.remedy} ({act.on} in the rig file)"
    return finding.remedy


class _ExaminationPage(Themed, QWidget):
    """At most one examination, and its findings.

    act: Receives an action, ``"again"`` or ``"calibrate"``, and its subject.
    """

    def __init__(self, context: TabContext, act: Callable[[str, str], object]) -> None:
        super().__init__()
        self._context, self._act = context, act
        self.command = OwnCommand(context)
        self.findings: list[Finding] = []
        self.buttons: dict[int, QToolButton] = {}
        tip = "Open, identify and exercise every instrument"
        self.examine = ui.action(self, "E&xamine", partial(act, "again", ""), "Ctrl+I", tip=tip)
        tip = "End the examination; instruments are muted and parked first"
        self.cancel = ui.action(self, "&Cancel the examination", self.command.interrupt, tip=tip)
        tip = "Without sweeps nothing sounds; loopback and response are not checked"
        self.plays = ui.check("&Play sweeps", tip, on=True)
        self.summary = ui.label("Result of the examination")
        self.table = ui.table(_HEADINGS, "Findings", stretched=(3, 4))
        buttons = map(ui.button, (self.examine, self.cancel))
        controls = ui.row(*buttons, self.plays, self.summary, None)
        ui.column(controls, (self.table, 1), owner=self, margins=ui.PAGE_MARGINS)
        self.clear()

    def start(self, rig: Path, holds: str) -> None:
        """Examine; `holds` as of `OwnCommand.run`."""
        quiet = [] if self.plays.isChecked() else ["--no-play"]
        self.clear()
        self.summary.setText("examining…")
        self.command.run(["doctor", str(rig), "--lines", *quiet], self._ended, self._receive, holds=holds)

    def clear(self) -> None:
        self.findings, self.buttons = [], {}
        self.table.setRowCount(0)
        self.summary.setText("not examined yet")

    def _receive(self, message: Message) -> None:
        if "finding" in message:
            self._add(from_record(FindingMade, message).finding)

    def _add(self, finding: Finding) -> None:
        number, theme = len(self.findings), self.theme
        self.findings.append(finding)
        self.table.insertRow(number)
        colours = {"ok": theme.good, "warn": theme.warning, "fail": theme.fault}
        texts = _VERDICTS[finding.verdict][0], finding.instrument, finding.check, finding.what, remedy_of(finding)
        ui.fill_row(self.table, number, texts, {0: colours.get(finding.verdict, theme.faint)})
        if (wanted := button_of(finding)) is not None:
            action, text = wanted
            on = "" if finding.act is None else finding.act.on
            tip, name = finding.remedy or finding.what, f"{text}: {finding.instrument}, {finding.check}"
            button = self.buttons[number] = ui.tool_button(text, tip, partial(self._act, action, on), name)
            self.table.setCellWidget(number, len(_HEADINGS) - 1, button)
        self.summary.setText(f"examining… {number + 1} findings; last: {finding.instrument}, {finding.check}")
        self.table.scrollToBottom()

    def _ended(self, process: CommandProcess) -> None:
        code, verdicts = process.exit_code, [one.verdict for one in self.findings]
        if code in (0, 1) and verdicts:
            counted = ", ".join(
                f"{verdicts.count(one)} {words}" for one, (_, words) in _VERDICTS.items() if one in verdicts
            )
            self.summary.setText(f"✔ all well: {counted}" if code == 0 else counted)
            self.table.scrollToItem(self.table.item(verdicts.index("fail") if "fail" in verdicts else 0, 0))
        else:
            self.summary.setText("the examination was not completed")
            self._context.report_end(process, stopped="cancelled; the instruments were put to rest")


class RigTab(Tab):
    """Three pages about one rig file."""

    title = "Rig"
    kinds = (FileKind.RIG,)

    def __init__(self, context: TabContext) -> None:
        super().__init__(context)
        self.rig: Path | None = None
        self.session = ManualSession(context)
        self.calibration = Calibration(context)
        self.rig_field = PathField("Ri&g", ".toml", "rig file", context)
        self.examination = _ExaminationPage(context, self.do)
        self.manual_page = ManualPage(self.session, self.take)
        self.calibration_page = CalibrationPage(self.calibration, self.calibrate)
        pages = {"Examination": self.examination, "By hand": self.manual_page, "Calibration": self.calibration_page}
        self.pages = ui.tab_pages("Pages of the rig", pages)
        ui.column(self.rig_field, (self.pages, 1), owner=self, margins=ui.PAGE_MARGINS)
        self.remember(hand=self.manual_page.splitter, calibration=self.calibration_page.splitter)
        self.rig_field.chosen.connect(self.open_file)
        page = self.manual_page
        self._with_instruments = [page.sound.sweep, page.mute, page.jog.park]
        remembered = context.settings.text("rig/file")
        if remembered and Path(remembered).is_file():
            self._show_rig(Path(remembered))

    def menu_actions(self) -> list[QAction | None]:
        page, examination = self.manual_page, self.examination
        return [examination.examine, examination.cancel, page.take, page.release, None, *self._with_instruments]

    def open_file(self, path: Path) -> None:
        """Use another rig; open instruments are closed first, and one that is being measured stays."""
        if self.rig is not None and (busy := self._busy()):
            if path.absolute() != self.rig.absolute():
                self._refuse(self.rig, busy)
            self.context.share(self, FileKind.RIG, path)
            self.rig_field.show_path(self.rig)
            return
        self.session.release()
        self._show_rig(path)
        self.context.share(self, FileKind.RIG, path)

    def use_shared(self, kind: FileKind, path: Path) -> None:
        if kind is FileKind.RIG and not (self.session.running or self._busy()):
            self._show_rig(path)

    def examine(self) -> None:
        self._with_free_instruments("Examine", self.examination.start)

    def take(self) -> None:
        self._with_free_instruments("Open them", self.session.take)

    def calibrate(self, options: list[str]) -> None:
        self._with_free_instruments("Calibrate", lambda rig, holds: self.calibration.start(rig, options, holds))

    def do(self, action: str, on: str) -> None:
        """Press a finding's button."""
        if action == "again":
            self.examine()
        else:
            self.calibration_page.choose(on)
            self.pages.setCurrentWidget(self.calibration_page)

    def poll(self) -> None:
        """Enable what makes sense, also while the tab is hidden: its keys work in every tab."""
        has_rig, examining, state = self.rig is not None, self.examination.command.running, self.session.state
        page, examination, free = self.manual_page, self.examination, has_rig and not self._busy()
        examination.examine.setEnabled(has_rig and not examining)
        examination.cancel.setEnabled(examining)
        page.take.setEnabled(free and state == "released")
        page.release.setEnabled(state in ("opening", "ready"))
        for action in self._with_instruments:
            action.setEnabled(state == "ready")
        self.calibration_page.options.setEnabled(free)

    def shut_down(self) -> None:
        """Cancel an examination or a calibration; the window does not wait for it."""
        self.examination.command.interrupt()
        self.calibration.interrupt()  # it reads its input only while it asks

    def _busy(self) -> str:
        """What is being done to the rig; empty where its instruments are free, or open in this tab."""
        if self.examination.command.running:
            return "examined"
        return "calibrated" if self.calibration.running else ""

    def _refuse(self, rig: Path, busy: str) -> None:
        self.context.messages.warn(f"{rig.name} is being {busy}; wait for its end, or cancel it")

    def _show_rig(self, path: Path) -> None:
        self.context.settings.keep("rig/file", str(path.absolute()))
        self.rig_field.show_path(path)
        self.rig, surface, actuator_mm = path, Surface(), []
        self.examination.clear()
        try:
            rig = validated(RigConfig, read_toml(path), str(path))
            surface, actuator_mm = rig.surface, list(rig.actuators.position_mm)
        except InputError as wrong:
            self.context.messages.fault(str(wrong))
        self.manual_page.jog.picture.show_rig(surface.outline, actuator_mm)
        self.calibration_page.show_surface(surface, actuator_mm)

    def _with_free_instruments(self, word: str, act: Callable[[Path, str], object]) -> None:
        """Do something with the instruments, which receives rig and holder, as soon as nothing else has them."""
        rig, session = self.rig, self.session
        if rig is None:
            self.context.messages.warn("choose a rig file first")
        elif busy := self._busy():
            self._refuse(rig, busy)
        else:
            virtual = names_virtual_rig(rig)
            holds = "" if virtual else f"the Rig tab has the instruments of {rig.name}"
            free = partial(session.release, partial(act, rig, holds))
            self.context.claim_instruments(word, free, virtual=virtual, but=session)
