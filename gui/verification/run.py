"""A verification under way: started as a process, followed through its log, stopped by a file; and its progress row."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from PyQt5.QtWidgets import QHBoxLayout, QLabel, QProgressBar, QSizePolicy, QWidget

from config.messages.campaign import (
    Fault,
    ReconnectTried,
    State,
    StateChanged,
)
from config.messages.codec import MessageError, message_of
from config.messages.rig_checks import VERIFY_MESSAGES, VerifyEnded, VerifyStarted, VerifyStep
from gui.campaign.follower import LogTail
from gui.messages import error_text
from gui.process import STOPPED_BY_USER, CommandProcess
from gui.tab import Question, TabContext
from gui.theme import LIGHT, Theme
from gui.verification.request import Request
from gui.widgets import Badge, finish_text, make_action, make_button, put
from rendering.verify.record import LOG_NAME, RECORD_NAME, STOP_NAME

_MESSAGES = (*VERIFY_MESSAGES, StateChanged, Fault, ReconnectTried)
_NOT_GOOD_ENOUGH = 1
_SAID_NAME = "verify.said"
# A verification of another process whose log does not grow for so long has ended.
_SILENT_AFTER_S = 300.0
# Steps as the log names them, and as they are shown.
_STEPS = {"render": "rendering", "predict": "predicting", "scan": "scanning", "compare and report": "comparing"}


@dataclass(slots=True)
class Progress:
    """Progress of a verification; `finish_s` is when the step will end, in seconds since 1970, None where unknown."""

    step: str = "starting"
    done: int = 0
    total: int = 0
    finish_s: float | None = None
    message: str = ""


class VerificationRun:
    """At most one verification of this window; one of another process in the same folder is followed, too.

    Parameters
    ----------
    context : TabContext
        Starts commands and shows messages.
    done : callable
        Receives the record's path when a verification has one.
    """

    def __init__(self, context: TabContext, done: Callable[[Path], object]) -> None:
        self._context, self._done = context, done
        self.own: CommandProcess | None = None
        self.out: Path | None = None
        self.progress: Progress | None = None
        self.stopping = self.is_virtual = False
        self._close: Callable[[], object] | None = None
        self._log: LogTail | None = None
        self._started = False
        self._ended: VerifyEnded | None = None
        self._last_s = 0.0

    @property
    def running(self) -> bool:
        """Whether a verification runs, this window's or that of another process."""
        return self.progress is not None

    def start(self, request: Request) -> None:
        """Start it, unless one is running."""
        if self.running:
            self._context.messages.warn("a verification is still running; cancel it first, or wait for its end")
            return
        out = request.out
        try:
            out.mkdir(parents=True, exist_ok=True)
            for name in (LOG_NAME, STOP_NAME):  # of an earlier one
                (out / name).unlink(missing_ok=True)
        except OSError as failure:
            self._context.messages.fault(f"the verification cannot be started: {error_text(failure)}")
            return
        self._follow_log(out)
        self.own = self._context.run(
            request.arguments,
            lambda _process: self.poll(),
            log_file=out / _SAID_NAME,
            name="the verification",
            advice="its outputs ended with it, but the mirror stands where it was: run the verification again",
        )
        self.progress, self.is_virtual = Progress(), request.is_virtual

    def follow(self, out: Path) -> None:
        """Follow a verification of another process in a folder, where there is one."""
        log = out / LOG_NAME
        if self.running or not log.is_file():
            return
        with suppress(OSError):
            if time.time() - log.stat().st_mtime < _SILENT_AFTER_S:
                self._follow_log(out)
                self.is_virtual = False  # its rig is unknown
                self._read_log()
                if self._ended is not None or not self._started:
                    self._reset()
                else:
                    self.progress = self.progress or Progress()

    def cancel(self) -> None:
        """Stop it: outputs muted, mirror parked."""
        if self.running and not self.stopping:
            self.stopping = True
            if self._started:
                self._request_stop()

    def poll(self) -> None:
        """Read its log, and report its end; called often."""
        if not self.running:
            return
        over = self.own is not None and not self.own.running  # asked first: the last line may be written meanwhile
        self._read_log()
        if self.own is not None:
            if over:
                own, self.own = self.own, None
                self._report_end(own.exit_code, own.failure)
        elif self._ended is not None:
            self._report_end(self._ended.code, "")
        elif time.time() - self._last_s > _SILENT_AFTER_S:
            self._reset()
            self._context.messages.warn("the verification of another process has written nothing for five minutes")

    def closing_question(self) -> Question | None:
        """What to ask before the window closes; None without a verification of its own."""
        if self.own is None or not self.own.running or self.out is None:
            return None

        def stop(close: Callable[[], object]) -> None:
            self._close = close
            self.cancel()
            if not self.running:
                close()

        return Question(
            f"A verification plays and scans into {self.out.name}. Stop it when the window closes?",
            (("Continue in the background", lambda close: close()), ("Stop, mute and park", stop)),
        )

    def detach(self) -> None:
        """Leave this window's verification running; it mutes and parks by itself."""
        if self.own is not None:
            self.own.detach()

    def _follow_log(self, out: Path) -> None:
        self.out, self._log = out, LogTail(out / LOG_NAME)
        self._started, self._ended, self.stopping, self._last_s = False, None, False, time.time()

    def _reset(self) -> None:
        self.progress, self._log, self.stopping = None, None, False

    def _read_log(self) -> None:
        for record in self._log.read()[0] if self._log is not None else ():
            self._last_s = time.time()
            self._receive(record)

    def _receive(self, record: dict[str, object]) -> None:
        progress = self.progress
        try:
            message = message_of(record, _MESSAGES)
        except MessageError:  # of another version
            return
        match message:
            case VerifyStarted():
                self._started = True
                if self.stopping:  # cancelled before it could look for the file
                    self._request_stop()
            case VerifyStep(step=step, done=done, total=total, left_s=left_s):
                finish_s = None if left_s is None else time.time() + left_s
                self.progress = Progress(step, done, total, finish_s, "" if progress is None else progress.message)
            case StateChanged(state=state, reason=reason) if progress is not None:
                progress.message = "" if state is State.RUNNING else reason
            case Fault(instrument=name, cause=what) | ReconnectTried(instrument=name, outcome=what) if (
                progress is not None
            ):
                progress.message = f"{name}: {what}"
            case VerifyEnded():
                self._ended = message

    def _request_stop(self) -> None:
        assert self.out is not None
        try:
            (self.out / STOP_NAME).touch()
        except OSError as failure:
            self.stopping = False
            self._context.messages.fault(f"the verification cannot be stopped: {error_text(failure)}")

    def _report_end(self, code: int | None, failure: str) -> None:
        out, ended, messages = self.out, self._ended, self._context.messages
        self._reset()
        assert out is not None
        with suppress(OSError):
            (out / STOP_NAME).unlink(missing_ok=True)
        reason = "" if ended is None else ended.reason
        if ended is not None and code == 0:
            messages.note(f"Verified. {reason}")
            self._done(out / RECORD_NAME)
        elif ended is not None and code == _NOT_GOOD_ENOUGH:
            messages.fault(f"Not good enough. {reason}")
            self._done(out / RECORD_NAME)
        elif code == STOPPED_BY_USER:
            messages.note("stopped; the outputs are muted and the mirror is parked, nothing was compared")
        else:
            messages.fault(reason or failure or "the verification ended")
        if self._close is not None:
            self._close()


class RunRow(QWidget):
    """One line: positions to scan (`choice`), buttons, step, progress, remaining time and last message."""

    def __init__(
        self,
        choice: QWidget,
        start: Callable[[], object],
        cancel: Callable[[], object],
        open_earlier: Callable[[], object],
    ) -> None:
        super().__init__()
        self._theme = LIGHT
        tip = "Play the scene on the rig, scan it and compare"
        self.start = make_action(self, "Verify", start, "Ctrl+Shift+V", tip=tip)
        tip = "Stop: outputs muted, mirror parked, nothing compared"
        self.cancel = make_action(self, "Cancel", cancel, "Ctrl+Shift+X", tip=tip)
        tip = "Show an earlier verification: choose its verify.json"
        self.open_earlier = make_action(self, "Open earlier…", open_earlier, "Ctrl+Shift+O", tip=tip)
        self._start_tip = self.start.toolTip()
        self.state = Badge("State of the verification")
        self.bar = QProgressBar()
        self.bar.setAccessibleName("Progress of the verification")
        self.bar.setMinimumWidth(120)
        self.figures = QLabel()
        self.figures.setAccessibleName("Remaining time and last message")
        self.figures.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(choice)
        row.addSpacing(8)
        for action in (self.start, self.cancel, self.open_earlier):
            row.addWidget(make_button(action))
        row.addSpacing(8)
        row.addWidget(self.state)
        row.addWidget(self.bar, stretch=2)
        row.addWidget(self.figures, stretch=3)
        self.show_progress(None, stopping=False, missing="")

    def show_progress(self, progress: Progress | None, *, stopping: bool, missing: str, reading: str = "") -> None:
        """Show the progress, or without one what is `missing` for a verification and what is being read."""
        running = progress is not None
        self.start.setEnabled(not running and not missing)
        self.start.setToolTip(f"First {missing}" if missing else self._start_tip)
        self.cancel.setEnabled(running and not stopping)
        self.open_earlier.setEnabled(not running)
        self.state.setVisible(running)
        self.bar.setVisible(running)
        if progress is None:
            put(self.figures, reading)
            self.figures.setToolTip("")
            return
        word = "stopping" if stopping else _STEPS.get(progress.step, progress.step)
        self.state.show_word(word, self._theme.warning if stopping else self._theme.good)
        self.bar.setFormat("%v of %m positions" if progress.step in ("scan", "predict") else "")
        if (self.bar.value(), self.bar.maximum()) != (progress.done, progress.total):
            self.bar.setMaximum(progress.total)  # 0: a busy indicator
            self.bar.setValue(progress.done)
        scanning = progress.step == "scan" and progress.done < progress.total
        left = finish_text(progress.finish_s) if scanning and progress.finish_s is not None else ""
        text = "  ·  ".join(part for part in (left, progress.message) if part)
        put(self.figures, text)
        self.figures.setToolTip(text)

    def apply_theme(self, theme: Theme) -> None:
        """Apply the theme's colours."""
        self._theme = theme
        self.state.apply_theme(theme)
