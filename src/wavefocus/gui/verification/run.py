"""A verification: started and followed as a process, stopped by a file; and the files that one has left."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.config.messages.campaign import Fault, ReconnectTried, State, StateChanged
from wavefocus.config.messages.codec import MessageError, message_of
from wavefocus.config.messages.rig_checks import VERIFY_MESSAGES, VerifyEnded, VerifyStarted, VerifyStep
from wavefocus.gui.campaign.follower import LogTail
from wavefocus.gui.message_bar import error_text
from wavefocus.gui.process import NOT_GOOD_ENOUGH, STOPPED_BY_USER, CommandProcess
from wavefocus.gui.surface import PlotSurface, raster_of
from wavefocus.gui.tab import ClosingQuestion, TabContext
from wavefocus.rendering.verify.record import (
    LOG_NAME,
    PREDICTION_NAME,
    RECORD_NAME,
    SCAN_NAME,
    STOP_NAME,
)
from wavefocus.storage.errors import InputError, WavefocusError

if TYPE_CHECKING:
    from wavefocus.rendering.verify.field_pair import FieldPair
    from wavefocus.rendering.verify.record import VerificationRecord

_MESSAGES = (*VERIFY_MESSAGES, StateChanged, Fault, ReconnectTried)


@dataclass(frozen=True, slots=True)
class VerificationRequest:
    """The command of a verification, and the folder that it writes."""

    arguments: tuple[str, ...]
    out: Path
    is_virtual: bool


@dataclass(slots=True)
class VerificationProgress:
    """Progress of a verification; `finish_s` is when the step will end, in seconds since 1970, None where unknown."""

    step: str = "starting"
    done: int = 0
    total: int = 0
    finish_s: float | None = None
    message: str = ""


class VerificationRun:
    """At most one verification of this window.

    context: Starts commands and shows messages.
    done: Receives the record's path when a verification has one.
    """

    def __init__(self, context: TabContext, done: Callable[[Path], object]) -> None:
        self._context, self._done = context, done
        self.own: CommandProcess | None = None
        self.out: Path | None = None
        self.progress = VerificationProgress()
        self.stopping = self.is_virtual = False
        self._close: Callable[[], object] | None = None
        self._started = False
        self._ended: VerifyEnded | None = None

    @property
    def running(self) -> bool:
        return self.own is not None

    def start(self, request: VerificationRequest) -> None:
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
        self.out, self._log, self.progress = out, LogTail(out / LOG_NAME), VerificationProgress()
        self._started, self._ended, self.stopping = False, None, False
        self.own = self._context.run(
            request.arguments,
            lambda _process: self.poll(),
            log_file=out / "verify.said",
            name="the verification",
            advice="its outputs ended with it, but the mirror stands where it was: run the verification again",
        )
        self.is_virtual = request.is_virtual

    def cancel(self) -> None:
        """Stop it: outputs muted, mirror parked."""
        if self.running and not self.stopping:
            self.stopping = True
            if self._started:
                self._request_stop()

    def poll(self) -> None:
        """Read its log, and report its end; called often."""
        own = self.own
        if own is None:
            return
        over = not own.running  # asked first: the last line may be written meanwhile
        for record in self._log.read()[0]:
            self._receive(record)
        if over:
            self._report_end(own)

    def closing_question(self) -> ClosingQuestion | None:
        """What to ask before the window closes; None without a verification."""
        if self.own is None or not self.own.running or self.out is None:
            return None

        def stop(close: Callable[[], object]) -> None:
            self._close = close
            self.cancel()
            if not self.running:
                close()

        return ClosingQuestion(
            f"A verification plays and scans into {self.out.name}. Stop it when the window closes?",
            (("Continue in the background", lambda close: close()), ("Stop, mute and park", stop)),
        )

    def detach(self) -> None:
        """Leave this window's verification running; it mutes and parks by itself."""
        if self.own is not None:
            self.own.detach()

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
                self.progress = VerificationProgress(step, done, total, finish_s, progress.message)
            case StateChanged(state=state, reason=reason):
                progress.message = "" if state is State.RUNNING else reason
            case Fault(instrument=name, cause=what) | ReconnectTried(instrument=name, outcome=what):
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

    def _report_end(self, own: CommandProcess) -> None:
        out, ended, messages, code = self.out, self._ended, self._context.messages, own.exit_code
        self.own, self.stopping = None, False
        assert out is not None
        with suppress(OSError):
            (out / STOP_NAME).unlink(missing_ok=True)
        reason = own.failure if ended is None else ended.reason
        if code == 0:
            messages.note(f"Verified. {reason}")
        elif code == NOT_GOOD_ENOUGH:
            messages.fault(f"Not good enough. {reason}")
        elif code == STOPPED_BY_USER:
            messages.note(
                "stopped; the outputs are muted and the mirror is parked; Verify goes on with what was scanned"
            )
        else:
            messages.fault(reason or "the verification ended")
        if code in (0, NOT_GOOD_ENOUGH):
            self._done(out / RECORD_NAME)
        if self._close is not None:
            self._close()


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """One verification.

    folder: Folder of prediction, scan and report.
    record: Figures, foci, sources, errors.
    pair: Prediction and scan.
    surface: What the maps are drawn over.
    focus_sample, int64 (foci,): Samples of the fields at which foci were looked at.
    loudest, loudest_difference: Ends of the scales for the whole scene, in response units.
    """

    folder: Path
    record: VerificationRecord
    pair: FieldPair
    surface: PlotSurface
    focus_sample: NDArray[np.int64]
    loudest: float
    loudest_difference: float


def read_results(record_file: Path, on_progress: Callable[[int, int], object], wanted: Callable[[], bool]) -> Results:
    """Read a verification; takes a second for some hundred megabytes.

    Raises InputError: A file is missing, damaged or of another verification; the message names it.
    Raises CancelledError: `wanted` returned False.
    """
    from wavefocus.rendering.verify.field_pair import read_pair  # the window starts without scipy
    from wavefocus.rendering.verify.record import read_record

    record = read_record(record_file)
    folder = record_file.parent
    pair = read_pair(folder / PREDICTION_NAME, folder / SCAN_NAME, record.band_hz, on_progress, wanted)
    if not np.array_equal(pair.position_index, record.position_index):
        raise InputError(
            f"{folder / PREDICTION_NAME} has other positions than {record_file}; run the verification again"
        )
    focus = np.array([pair.sample_at(time_s) for time_s in record.focus_s], np.int64)
    looked_at = focus if len(focus) else evenly_spread(pair.samples, 64)
    loudest, difference = pair.loudest(looked_at, record.compared)
    checks = _check_places(record)
    surface = PlotSurface(
        record.position_mm, record.actuator_places_mm,
        None if record.outline_mm is None else np.array(record.outline_mm),
        raster_of(record.position_mm, checks, gaps=False), [np.array(source.path_mm) for source in record.sources],
        checks,
    )  # fmt: skip
    return Results(folder, record, pair, surface, focus, loudest, difference)


def _check_places(record: VerificationRecord) -> NDArray[np.intp]:
    """Which positions of a verification lie off its bank's grid; none where the bank is not there any more."""
    from wavefocus.storage.bank.reading import open_bank

    with suppress(WavefocusError, OSError), open_bank(Path(record.bank)) as bank:
        return np.flatnonzero(np.isin(record.position_index, bank.check_rows))
    return np.zeros(0, np.intp)
