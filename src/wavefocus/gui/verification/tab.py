"""The Verification tab: the choices of a verification, its process, its progress, and what it found."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QAction, QLineEdit, QStackedWidget, QWidget

from wavefocus.config.messages import MessageError, message_of
from wavefocus.config.messages.campaign import Fault, ReconnectTried, State, StateChanged
from wavefocus.config.messages.rig_checks import VERIFY_MESSAGES, VerifyEnded, VerifyStarted, VerifyStep
from wavefocus.console import Exit
from wavefocus.gui import widgets as ui
from wavefocus.gui.campaign.follower import LogTail
from wavefocus.gui.files import FileKind, PathField, names_virtual_rig, record_of
from wavefocus.gui.message_bar import error_text
from wavefocus.gui.process import CommandProcess
from wavefocus.gui.surface import VIRTUAL
from wavefocus.gui.tab import ClosingQuestion, OwnCommand, Tab, TabContext
from wavefocus.gui.theme import Themed
from wavefocus.gui.verification.panels import FiguresPanel, MapsPanel, Results, VerdictPanel, read_results
from wavefocus.rendering.verify.record import FIELD_NAMES, LOG_NAME, PICTURE_NAMES, RECORD_NAME, REPORT_NAME, STOP_NAME

_MESSAGES = (*VERIFY_MESSAGES, StateChanged, Fault, ReconnectTried)


_NO_STEP = VerifyStep(datetime.fromtimestamp(0, UTC), "starting", 0, 0)


class _VerificationRun(OwnCommand):
    """At most one verification of this window.

    done: Receives the record's path when a verification has one.

    step: The last one that it reported.
    message: What an instrument said last; empty while all is well.
    """

    def __init__(self, context: TabContext, done: Callable[[Path], object]) -> None:
        super().__init__(context)
        self._done = done
        self.out = Path()
        self.stopping = False
        self._log: LogTail | None = None
        self._close: Callable[[], object] = lambda: None
        self._forget()

    def start(self, arguments: Sequence[str], out: Path, *, virtual: bool) -> None:
        """Start a command that writes a folder, unless one is running."""
        if self.running:
            self._context.messages.warn("a verification is still running; cancel it first, or wait for its end")
            return
        try:
            out.mkdir(parents=True, exist_ok=True)
            (out / LOG_NAME).unlink(missing_ok=True)  # of an earlier one
        except OSError as failure:
            self._context.messages.fault(f"the verification cannot be started: {error_text(failure)}")
            return
        self._forget()
        self.out, self._log = out, LogTail(out / LOG_NAME)
        self.run(
            arguments,
            self._report_end,
            holds="" if virtual else f"a verification into {out} plays and scans",
            log_file=out / "verify.said",
            name="the verification",
            advice="its outputs ended with it, but the mirror stands where it was: run the verification again",
        )

    def cancel(self) -> None:
        """Stop it: outputs muted, mirror parked. Before its log begins it has no instruments, and is ended."""
        if self.own is not None and not self.stopping:
            self.stopping = True
            self.poll()
            if not self._started:
                self.own.kill()
                return
            try:
                (self.out / STOP_NAME).touch()  # on Windows no signal reaches a process without a console
            except OSError:
                self.own.interrupt()

    def poll(self) -> bool:
        """Read what is new in its log, a block of it; returns whether there was anything."""
        records = [] if self._log is None else self._log.read()[0]
        for record in records:
            with suppress(MessageError):  # of another version
                self._receive(message_of(record, _MESSAGES))
        return bool(records)

    def closing_question(self) -> ClosingQuestion | None:
        if not self.running:
            return None

        def stop(close: Callable[[], object]) -> None:
            self._close = close
            self.cancel()
            if not self.running:
                close()

        sentence = f"A verification plays and scans into {self.out.name}. Stop it when the window closes?"
        return sentence, (("Continue in the background", lambda close: close()), ("Stop, mute and park", stop))

    def _forget(self) -> None:
        self.step, self.message, self._reason = _NO_STEP, "", ""
        self.stopping = self._started = False
        self._close = lambda: None

    def _receive(self, message: object) -> None:
        match message:
            case VerifyStarted():
                self._started = True
            case VerifyStep():
                self.step = message
            case StateChanged(state=state, reason=reason):
                self.message = "" if state is State.RUNNING else reason
            case Fault(instrument=name, cause=what) | ReconnectTried(instrument=name, outcome=what):
                self.message = f"{name}: {what}"
            case VerifyEnded(reason=reason):
                self._reason = reason

    def _report_end(self, process: CommandProcess) -> None:
        while self.poll():
            pass
        self._log = None
        stopped = "stopped; the outputs are muted and the mirror is parked; Verify goes on with what was scanned"
        judged = process.exit_code in (Exit.DONE, Exit.NOT_GOOD_ENOUGH)
        why = f"Not good enough. {self._reason}" if judged else self._reason
        self._context.report_end(process, f"Verified. {self._reason}", stopped, why)
        if judged:
            self._done(self.out / RECORD_NAME)
        self._close()


class _RequestForm(QWidget):
    """Fields for scene, bank, rig, folder and the positions to scan."""

    def __init__(self, context: TabContext) -> None:
        super().__init__()
        self._context = context
        self.scene = PathField("&Scene", ".toml", "scene file", context)
        self.bank = PathField("&Bank", ".h5", "bank file", context)
        self.rig = PathField("Ri&g", ".toml", "rig file", context, words=(VIRTUAL,))
        self.rig.line.setToolTip(f"A rig file, or the word {VIRTUAL} for the rig in software")
        self.out = PathField("F&older", "", "folder for the report", context)
        self._filled: dict[PathField, Path] = {}
        """What was filled in by itself, and follows the bank."""
        tip = "Bank rows to scan: path (along the scene's paths), every:4 (one in four), or rows as 3,5-9; empty: all"
        self.positions = ui.named(QLineEdit(), tip, "Positions to scan")
        self.positions.setPlaceholderText("all; or path, every:4, 3,5-9")
        self.positions.setMinimumWidth(self.fontMetrics().horizontalAdvance(self.positions.placeholderText()) + 20)
        ui.column(ui.row((self.scene, 1), (self.bank, 1)), ui.row((self.rig, 1), (self.out, 1)), owner=self)
        self.bank.chosen.connect(self.take_bank)
        self.rig.chosen.connect(lambda path: context.share(self, FileKind.RIG, path))

    def take_bank(self, bank: Path) -> None:
        """Verify a bank; empty fields are filled with the files next to it."""
        self.bank.show_path(bank)
        self._context.share(self, FileKind.BANK, bank)
        for field, name in ((self.scene, "scene.toml"), (self.rig, "rig.toml"), (self.out, "verify")):
            neighbour = bank.with_name(name)
            empty = not field.line.text().strip() or field.path == self._filled.get(field)
            if empty and (field is self.out or neighbour.is_file()):
                field.show_path(neighbour)
                self._filled[field] = neighbour

    def missing(self) -> str:
        """What has to be chosen first; empty when a verification can be started."""
        names = (self.scene, "a scene file"), (self.bank, "a bank"), (self.rig, "a rig file"), (self.out, "a folder")
        words = [word for field, word in names if not field.line.text().strip()]
        return f"choose {' and '.join(', '.join(words).rsplit(', ', 1))}" if words else ""

    def arguments(self, out: Path) -> list[str]:
        """The command of the present choices, into a folder."""
        files = ["--bank", str(self.bank.path), "--rig", str(self.rig.path or VIRTUAL), "--out", str(out), "--json"]
        positions = self.positions.text().strip()
        return ["verify", str(self.scene.path), *files, *(["--positions", positions] if positions else [])]


def unused_folder(folder: Path) -> Path:
    """Return the folder, or the first of ``NAME-2``, ``NAME-3``, ... where it holds results of a verification."""
    stem, _, number = folder.name.rpartition("-")
    numbers = stem.strip(".") and number.isdecimal() and folder.with_name(stem).is_dir()
    name = stem if numbers else folder.name
    others = (folder.with_name(f"{name}-{count}") for count in itertools.count(2))
    return next(one for one in itertools.chain([folder], others) if not _holds_results(one))


def _holds_results(folder: Path) -> bool:
    names = (RECORD_NAME, REPORT_NAME, *FIELD_NAMES, *PICTURE_NAMES)
    return any(os.path.lexists(folder / name) for name in names) or (os.path.lexists(folder) and not folder.is_dir())


# Steps as the log names them, and as they are shown.
_STEPS = {
    "render": "rendering",
    "predict": "predicting",
    "sentinel": "measuring the sentinel position",
    "scan": "scanning",
    "linearity": "scanning, quieter",
    "compare and report": "comparing",
}


_WITH_COUNT = ("scan", "predict", "linearity")


class _RunRow(Themed, QWidget):
    """One line: positions to scan, buttons, step, progress, remaining time and last message."""

    def __init__(self, positions: QLineEdit, start: Callable[[], object], cancel: Callable[[], object]) -> None:
        super().__init__()
        tip = "Play the scene on the rig, scan it and compare"
        self.start = ui.action(self, "Verify", start, "Ctrl+Shift+V", tip=tip)
        tip = "Stop: outputs muted, mirror parked; Verify then goes on with the scan"
        self.cancel = ui.action(self, "Cancel", cancel, "Ctrl+Shift+X", tip=tip)
        self.state = ui.Badge("State of the verification")
        self.bar = ui.progress_bar("Progress of the verification", "%v of %m positions")
        self.bar.setMinimumWidth(120)
        self.figures = ui.label("Remaining time and last message", any_width=True)
        buttons = map(ui.button, (self.start, self.cancel))
        choice = ui.labelled("&Positions", positions)
        ui.row(*choice, 8, *buttons, 8, self.state, (self.bar, 2), (self.figures, 3), owner=self)

    def show_run(self, run: _VerificationRun, text: str) -> None:
        """Show the progress of a verification; without one, a text."""
        self.cancel.setEnabled(run.running and not run.stopping)
        for part in (self.state, self.bar):
            part.setVisible(run.running)
        if run.running:
            step = run.step
            word = "stopping" if run.stopping else _STEPS.get(step.step, step.step)
            self.state.show_word(word, self.theme.warning if run.stopping else self.theme.good)
            self.bar.setFormat("%v of %m positions" if step.step in _WITH_COUNT else "")
            self.bar.setMaximum(step.total)  # 0: a busy indicator
            self.bar.setValue(step.done)
            goes_on = step.step == "scan" and step.left_s is not None and step.done < step.total
            left = ui.finish_text(step.at.timestamp() + (step.left_s or 0.0)) if goes_on else ""
            text = "  ·  ".join(filter(None, (left, run.message)))
        self.figures.setText(text)
        self.figures.setToolTip(text)


_HINT = (
    "Choose a scene, a bank, a rig and a folder, and press Verify: the scene is played and scanned, and compared with "
    "what the bank predicts.\n\nFile > Open shows an earlier verification by its verify.json."
)
_WAITING = "Prediction, scan and difference are shown here when the scan is done."


class VerificationTab(Tab):
    """Verify a scene, or look at what an earlier verification found."""

    title = "Verification"
    kinds = (FileKind.VERIFICATION,)

    def __init__(self, context: TabContext) -> None:
        super().__init__(context)
        self.results: Results | None = None
        self._reading = ""
        self.run = _VerificationRun(context, self._open_record)
        self.form = _RequestForm(context)
        self.row = _RunRow(self.form.positions, self._start, self.run.cancel)
        self.verdict = VerdictPanel()
        self.maps = MapsPanel()
        self.figures = FiguresPanel(self._open)
        self._lay_out()
        self.form.out.chosen.connect(self._folder_chosen)

    def menu_actions(self) -> list[QAction | None]:
        return [self.row.start, self.row.cancel]

    def open_file(self, path: Path) -> None:
        """Look at the verification that a file or a folder belongs to."""
        record = record_of(path)
        if record is not None:
            self._open_record(record)

    def poll(self) -> None:
        self.run.poll()

    def use_shared(self, kind: FileKind, path: Path) -> None:
        form = self.form
        taken = {FileKind.BANK: form.take_bank, FileKind.RIG: form.rig.show_path, FileKind.SCENE: form.scene.show_path}
        if kind in taken and not self.run.running:
            taken[kind](path)

    def draw(self) -> None:
        missing = self.form.missing()
        self.hint.setText(_WAITING if self.run.running else _HINT)
        self.row.start.setEnabled(not self.run.running and not missing)
        self.row.show_run(self.run, self._reading or missing)

    def shut_down(self) -> None:
        self._reading = ""  # ends the reading

    def _lay_out(self) -> None:
        waveforms, shown = QWidget(), QWidget()
        ui.column(self.maps.legend, (self.maps.response, 1), owner=waveforms, spacing=2)
        lower = ui.side_by_side((waveforms, 515), (self.figures, 745))
        both = ui.side_by_side((self.maps, 360), (lower, 260), growing=[0], above=True)
        form = self.form
        self.remember(scene=form.scene, bank=form.bank, rig=form.rig, out=form.out, rows=form.positions)
        self.remember(lower=lower, both=both)
        ui.column(self.verdict, (both, 1), owner=shown)
        self.pages = QStackedWidget()
        self.hint = ui.label(text=_HINT, role="faint", wraps=True)
        self.hint.setAlignment(Qt.Alignment() | Qt.AlignmentFlag.AlignCenter)
        self.hint.setMargin(40)
        for page in (self.hint, shown):
            self.pages.addWidget(page)
        ui.column(self.form, self.row, (self.pages, 1), owner=self, margins=ui.PAGE_MARGINS)

    def _start(self) -> None:
        """Verify; results in the folder are kept, and a numbered folder is used instead."""
        if self.form.out.path is None or self.form.missing():  # by a key, before the button is disabled
            return
        out, virtual = unused_folder(self.form.out.path), names_virtual_rig(self.form.rig.path or VIRTUAL)
        self.form.out.show_path(out)
        start = partial(self.run.start, self.form.arguments(out), out, virtual=virtual)
        self.context.claim_instruments("Verify", start, virtual=virtual)

    def _folder_chosen(self, folder: Path) -> None:
        """Show an earlier verification of that folder."""
        if not self.run.running:
            self.open_file(folder)

    def _open_record(self, record: Path) -> None:
        """Read a verification and show it when it is there."""
        self.context.settings.opened(record)
        reading = self._reading = f"reading {record.parent.name}…"
        work = partial(read_results, record, lambda: self._reading is reading)
        self.context.background.ask("verification", work, self._show, self._fail)

    def _show(self, results: Results) -> None:
        self._reading = ""
        self.results = results
        self.pages.setCurrentIndex(1)
        for panel in (self.verdict, self.maps, self.figures):
            panel.show_results(results)

    def _fail(self, failure: Exception) -> None:
        self._reading = ""
        self.context.report_failure(failure)

    def _open(self, name: str) -> None:
        """Open a file of the folder, or the folder itself where the name is empty."""
        if self.results is not None:
            path = self.results.folder / name
            if path.exists():
                self.context.open_outside(path)
            else:
                self.context.messages.fault(f"{path} is gone; run the verification again")
