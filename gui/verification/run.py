"""A verification under way: started in a process of its own, followed through its log, ended by an order."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from gui.process.command_process import STOPPED_BY_USER, CommandProcess
from gui.process.log_tail import LogTail
from gui.shell.error_hook import error_text
from gui.shell.tab import Question, TabContext
from gui.verification.request import Request
from rendering.verify.record import LOG_NAME, RECORD_NAME, STOP_NAME

_NOT_GOOD_ENOUGH = 1
_SAID_NAME = "verify.said"
# A verification of another process that tells nothing for so long is taken for gone.
_SILENT_AFTER_S = 300.0
_STOPPED_WORDS = "stopped; the outputs are muted and the mirror is parked, nothing was compared"


@dataclass(slots=True)
class Progress:
    """How far a verification is.

    Parameters
    ----------
    step : str
        What it does.
    done, total : int
        Of that step.
    finish_s : float or None
        When the step will be done, by this clock since 1970.
    message : str
        The last that it told.
    """

    step: str = "starting"
    done: int = 0
    total: int = 0
    finish_s: float | None = None
    message: str = ""


class VerificationRun:
    """At most one verification of the window's own; one of another process in the same folder is followed too.

    Parameters
    ----------
    context : TabContext
        Starts commands and tells sentences.
    done : callable
        Called with the record's path when a verification has one.
    """

    def __init__(self, context: TabContext, done: Callable[[Path], object]) -> None:
        self._context = context
        self._done = done
        self.own: CommandProcess | None = None
        self.out: Path | None = None
        self.progress: Progress | None = None
        self.stopping = self.is_virtual = False
        self._closes: Callable[[], object] | None = None
        self._tail: LogTail | None = None
        self._heard = False
        self._ended: dict[str, object] | None = None
        self._last_s = 0.0

    @property
    def alive(self) -> bool:
        """Whether a verification of this window runs."""
        return self.own is not None and self.own.running

    @property
    def running(self) -> bool:
        """Whether a verification runs, this window's or that of another process."""
        return self.progress is not None

    def start(self, request: Request) -> None:
        """Start it, unless one is running."""
        if self.running:
            self._context.messages.warn("a verification is still running; cancel it first, or wait for its end")
            return
        self._start(request)

    def follow(self, out: Path) -> None:
        """Follow what another process does in a folder; nothing happens where nobody works."""
        if self.running or not (out / LOG_NAME).is_file():
            return
        try:
            silent_s = time.time() - (out / LOG_NAME).stat().st_mtime
        except OSError:
            return
        if silent_s < _SILENT_AFTER_S:
            self._listen(out)
            self.is_virtual = False  # nobody knows
            self._take()
            if self._ended is not None or not self._heard:
                self._forget()
            else:
                self.progress = self.progress or Progress()

    def cancel(self) -> None:
        """Let it end: outputs muted, mirror parked."""
        if not self.running or self.stopping:
            return
        self.stopping = True
        if self._heard:
            self._order_stop()

    def look(self) -> None:
        """Take up what it told, and tell how it ended; called often."""
        if not self.running:
            return
        alive = self.own is not None and self.own.running  # before the log is read: its last line may come meanwhile
        self._take()
        if self.own is not None:
            if not alive:
                own, self.own = self.own, None
                self._tell_end(own.exit_code, own)
        elif self._ended is not None:
            code = self._ended.get("code")
            self._tell_end(code if isinstance(code, int) else None, None)
        elif time.time() - self._last_s > _SILENT_AFTER_S:
            self._forget()
            self._context.messages.warn("the verification of another process has told nothing for five minutes")

    def closing_question(self) -> Question | None:
        """What is to become of the own verification; None when there is none."""
        if not self.alive or self.out is None:
            return None

        def stop(close: Callable[[], object]) -> None:
            self._closes = close
            self.cancel()
            if not self.running:
                close()

        return Question(
            f"A verification of this window plays and scans into {self.out.name}. What should it do when the window "
            "closes?",
            (("Go on in the background", lambda close: close()), ("Stop, muted and parked", stop)),
        )

    def let_go(self) -> None:
        """Leave the own verification to itself; its last act is to mute and park."""
        if self.own is not None:
            self.own.detach()

    def _start(self, request: Request) -> None:
        out = request.out
        try:
            out.mkdir(parents=True, exist_ok=True)
            for name in (LOG_NAME, STOP_NAME):  # of an earlier one
                (out / name).unlink(missing_ok=True)
            self._listen(out)
        except OSError as failure:
            self._forget()
            self._context.messages.fault(f"the verification cannot be started: {error_text(failure)}")
            return
        self.own = self._context.run(
            request.arguments,
            lambda _process: self.look(),
            log_file=out / _SAID_NAME,
            name="the verification",
            advice="its outputs ended with it, but the mirror stands where it was: run the verification again",
        )
        self.progress, self.is_virtual = Progress(), request.is_virtual

    def _listen(self, out: Path) -> None:
        self.out, self._tail = out, LogTail(out / LOG_NAME)
        self._heard, self._ended, self.stopping, self._last_s = False, None, False, time.time()

    def _forget(self) -> None:
        self.progress, self._tail, self.stopping = None, None, False

    def _take(self) -> None:
        if self._tail is None:
            return
        records, _ = self._tail.read()
        for record in records:
            self._last_s = time.time()
            self._take_one(record)

    def _take_one(self, record: dict[str, object]) -> None:
        match record:
            case {"event": "started"}:
                self._heard = True
                if self.stopping:  # asked for before it could hear
                    self._order_stop()
            case {"event": "step", "step": str(step), "done": int(done), "total": int(total), "left_s": left_s}:
                finish_s = time.time() + left_s if isinstance(left_s, int | float) else None
                message = self.progress.message if self.progress is not None else ""
                self.progress = Progress(step, done, total, finish_s, message)
            case {"event": "state_changed", "state": str(state), "reason": str(reason)}:
                self._say("" if state == "running" else reason)
            case {"event": "fault", "instrument": str(instrument), "cause": str(cause)}:
                self._say(f"{instrument}: {cause}")
            case {"event": "reconnect_tried", "instrument": str(instrument), "outcome": str(outcome)}:
                self._say(f"{instrument}: {outcome}")
            case {"event": "ended"}:
                self._ended = record

    def _say(self, message: str) -> None:
        if self.progress is not None:
            self.progress.message = message

    def _order_stop(self) -> None:
        if self.out is None:
            return
        try:
            (self.out / STOP_NAME).touch()
        except OSError as failure:
            self.stopping = False
            self._context.messages.fault(f"the order to stop cannot be given: {error_text(failure)}")

    def _tell_end(self, code: int | None, own: CommandProcess | None) -> None:
        out, ended = self.out, self._ended
        self._forget()
        assert out is not None
        with suppress(OSError):
            (out / STOP_NAME).unlink(missing_ok=True)
        reason = str(ended.get("reason", "")) if ended is not None else ""
        messages, record = self._context.messages, out / RECORD_NAME
        if ended is not None and code == 0:
            messages.note(f"Verified. {reason}")
            self._done(record)
        elif ended is not None and code == _NOT_GOOD_ENOUGH:
            messages.fault(f"Not good enough. {reason}")
            self._done(record)
        elif code == STOPPED_BY_USER:
            messages.note(_STOPPED_WORDS)
        else:
            messages.fault(reason or (own.failure if own is not None else "") or "the verification ended")
        if self._closes is not None:
            self._closes()
