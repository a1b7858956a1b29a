"""The Rig tab: one rig file, and one command at a time that holds its instruments."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from PyQt5.QtCore import QUrl
from PyQt5.QtGui import QDesktopServices
from PyQt5.QtWidgets import QAction, QApplication, QHBoxLayout, QPushButton, QTabWidget, QVBoxLayout

from gui.rig.calibration import Calibration
from gui.rig.calibration_page import CalibrationPage
from gui.rig.examination import Examination
from gui.rig.examination_page import ExaminationPage
from gui.rig.hand_page import HandPage
from gui.rig.hands import Hands
from gui.rig.rig_file import RigFile, line_of, read_rig_file
from gui.shell.file_choice import PathField
from gui.shell.tab import Question, Tab, TabContext
from gui.shell.theme import Theme
from gui.shell.toml_files import TomlKind, rig_of_run, toml_kind
from gui.shell.widgets import make_action
from storage.errors import InputError


class RigTab(Tab):
    """Examine a rig, operate it by hand, calibrate it."""

    title = "Rig"
    opens = (".toml",)

    def __init__(self, context: TabContext) -> None:
        super().__init__(context)
        self.rig: RigFile | None = None
        self.hands = Hands(context)
        self.calibration = Calibration(context)
        self.rig_field = PathField("Ri&g", ".toml", "rig file", context.settings)
        self.of_run = QPushButton("Of the &run")
        self.of_run.setAccessibleName("Take the rig of the run file")
        self.of_run.setToolTip("Take the rig file that the Campaign tab's run file names")
        self.examination_page = ExaminationPage()
        self.examination = Examination(context, self.examination_page)
        self.hand_page = HandPage(self.hands)
        self.calibration_page = CalibrationPage(self.calibration, context.settings)
        self.pages = QTabWidget()
        self.pages.setAccessibleName("Pages of the rig")
        self.pages.setDocumentMode(True)
        for page, words in (
            (self.examination_page, "Examination"),
            (self.hand_page, "By hand"),
            (self.calibration_page, "Calibration"),
        ):
            self.pages.addTab(page, words)
        files = QHBoxLayout()
        files.addWidget(self.rig_field, stretch=1)
        files.addWidget(self.of_run)
        column = QVBoxLayout(self)
        column.setContentsMargins(4, 6, 4, 4)
        column.addLayout(files)
        column.addWidget(self.pages, stretch=1)
        self.divide(hand=self.hand_page.splitter, calibration=self.calibration_page.splitter)
        self.rig_field.chosen.connect(self.open_file)
        self.of_run.clicked.connect(self._take_rig_of_run)
        self.examination_page.examine.clicked.connect(lambda _checked=False: self.examine())
        self.examination_page.cancel.clicked.connect(self.examination.cancel)
        self.examination_page.wanted.connect(self.do)
        self.hand_page.take.clicked.connect(self.take)
        self.calibration_page.start.started.connect(self.calibrate)
        self._actions = self._make_actions()
        remembered = context.settings.text("rig/file")
        if remembered and Path(remembered).is_file():
            self._show_rig(Path(remembered))

    def menu_actions(self) -> list[QAction | None]:
        """What the tab does, with keys."""
        return [*self._actions]

    def accepts(self, path: Path) -> bool:
        """TOML files that describe a rig."""
        return path.name.lower().endswith(".toml") and toml_kind(path) is TomlKind.RIG

    def open_file(self, path: Path) -> None:
        """Take another rig; the instruments of the one before are given back first."""
        self.hands.release()
        self.context.settings.opened(path)
        self.context.settings.keep("rig/file", str(path.absolute()))
        self._show_rig(path)

    def examine(self, *options: str) -> None:
        """Let the doctor look at the rig."""
        self._with_free_instruments("Examine", lambda rig: self.examination.start(rig.path, options))

    def take(self) -> None:
        """Take the instruments into the window's hands."""
        self._with_free_instruments("Take them", lambda rig: self.hands.take(rig.path))

    def calibrate(self, options: list[str]) -> None:
        """Calibrate the rig, asking whoever sits here."""
        self._with_free_instruments("Calibrate", lambda rig: self.calibration.start(rig.path, options))

    def do(self, deed: str, on: str) -> None:
        """Do what can be done about a finding."""
        rig = self.rig
        if rig is None:
            return
        match deed:
            case "again":
                self.examine()
            case "test-message":
                self.examine("--test-message")
            case "reset-usb":
                self.context.messages.ask(
                    f"Reset the USB device of the {on}? It is switched off and on; whatever uses it loses it.",
                    ("Reset it", lambda: self.examine("--reset-usb", on)),
                    ("Leave it", lambda: None),
                )
            case "calibrate":
                self.calibration_page.start.choose(on)
                self.pages.setCurrentWidget(self.calibration_page)
            case "run":
                clipboard = QApplication.clipboard()
                if clipboard is not None:
                    clipboard.setText(on)
                self.context.messages.note(f"copied: {on}; paste it into a terminal")
            case "edit-rig":
                line = line_of(rig.path, on)
                where = f", line {line}" if line else ""
                self.context.messages.warn(f"{on} stands in {rig.path}{where}; save it there, then Examine again")
                self._open(rig.path)
            case "open-folder":
                self._open(Path(on))

    def poll(self) -> None:
        """Take up what processes told."""
        self.examination.poll()
        self.hands.poll()
        self.calibration.poll(self._calibrated)

    def draw(self) -> None:
        """Draw what changed."""
        has_rig = self.rig is not None
        self.examination_page.show_busy(self.examination.running, has_rig=has_rig)
        busy = self.examination.running or self.calibration.running
        self.hand_page.draw(has_rig=has_rig and not busy)
        self.calibration_page.draw(has_rig=has_rig and not self.examination.running)

    def apply_theme(self, theme: Theme) -> None:
        """Take a theme's colours."""
        for page in (self.examination_page, self.hand_page, self.calibration_page):
            page.apply_theme(theme)

    def instruments_held(self) -> str:
        """What it does with the instruments."""
        busy = self.hands.held or self.examination.running or self.calibration.running
        if not busy or self.rig is None or self.rig.is_virtual:
            return ""
        return f"the Rig tab has the instruments of {self.rig.path.name}"

    def closing_question(self) -> Question | None:
        """Nothing to ask: instruments are put to rest whatever happens."""
        return None

    def shut_down(self) -> None:
        """Let go of the instruments: muted and parked by the processes that hold them."""
        self.hands.let_go()
        self.calibration.let_go()
        self.examination.let_go()
        self.calibration_page.start.close_down()

    def _make_actions(self) -> list[QAction | None]:
        return [
            make_action(self, "Examine", self.examine, "Ctrl+I"),
            make_action(self, "Cancel the examination", self.examination.cancel),
            None,
            make_action(self, "Take the instruments", self.take, "Ctrl+Shift+T"),
            make_action(self, "Give them back", self.hands.release, "Ctrl+Shift+G"),
            make_action(self, "Sweep", self.hand_page.sound.take_sweep, "F5"),
            make_action(self, "Mute", self.hand_page.sound.mute, "Ctrl+0"),
            make_action(self, "Park the beam", self.hands.park, "Ctrl+Shift+P"),
        ]

    def _show_rig(self, path: Path) -> None:
        self.rig_field.show_path(path)
        self.rig = RigFile(path)
        self.examination_page.begin()
        self.examination_page.finish("not examined yet")
        try:
            self.rig = read_rig_file(path)
        except InputError as wrong:
            self.context.messages.fault(str(wrong))
        rig = self.rig
        self.hand_page.jog.picture.show_surface(rig.length_mm, rig.width_mm, rig.actuator_mm)
        self.calibration_page.show_surface(rig.length_mm, rig.width_mm, rig.actuator_mm)

    def _with_free_instruments(self, word: str, act: Callable[[RigFile], object]) -> None:
        """Do something that needs the instruments, once nobody else in this window has them."""
        rig = self.rig
        if rig is None:
            self.context.messages.warn("choose a rig file first")
            return
        if self.examination.running or self.calibration.running:
            what = "examined" if self.examination.running else "calibrated"
            self.context.messages.warn(f"{rig.path.name} is being {what}; wait for its end, or cancel it")
            return
        self.context.claim_instruments(self, word, lambda: self.hands.release(lambda: act(rig)), virtual=rig.is_virtual)

    def _calibrated(self) -> None:
        outcome = self.calibration.outcome
        if outcome is not None and outcome.get("file"):
            self.context.messages.note(f"written: {outcome['file']}")

    def _take_rig_of_run(self) -> None:
        run = self.context.run_file()
        if run is None:
            self.context.messages.warn("the Campaign tab has no run file")
            return
        try:
            rig = rig_of_run(run)
        except InputError as wrong:
            self.context.messages.fault(str(wrong))
            return
        if rig is None:
            self.context.messages.warn(f'{run}: names no rig file (rig = "virtual" has none)')
            return
        self.open_file(rig)

    def _open(self, path: Path) -> None:
        if not QDesktopServices.openUrl(QUrl.fromLocalFile(str(path))):
            self.context.messages.warn(f"the desktop opens nothing for {path}; open it by hand")
