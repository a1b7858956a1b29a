"""A verification: started and followed as a process, stopped by a file; and the files that one has left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.config.messages.campaign import Fault, ReconnectTried, State, StateChanged
from wavefocus.config.messages.codec import MessageError, message_of
from wavefocus.config.messages.rig_checks import VERIFY_MESSAGES, VerifyEnded, VerifyStarted, VerifyStep
from wavefocus.exits import Exit
from wavefocus.gui.campaign.follower import LogTail
from wavefocus.gui.message_bar import error_text
from wavefocus.gui.process import CommandProcess
from wavefocus.gui.surface import PlotSurface, raster_of
from wavefocus.gui.tab import ClosingQuestion, OwnCommand, TabContext
from wavefocus.rendering.verify.record import LOG_NAME, PREDICTION_NAME, RECORD_NAME, SCAN_NAME, STOP_NAME
from wavefocus.storage.errors import InputError, WavefocusError

if TYPE_CHECKING:
    from wavefocus.rendering.verify.field_pair import FieldPair
    from wavefocus.rendering.verify.record import VerificationRecord

_MESSAGES = (*VERIFY_MESSAGES, StateChanged, Fault, ReconnectTried)


_NO_STEP = VerifyStep(datetime.fromtimestamp(0, UTC), "starting", 0, 0)


class VerificationRun(OwnCommand):
    """At most one verification of this window.

    done: Receives the record's path when a verification has one.

    step: The last one that it reported.
    message: What an instrument said last; empty while all is well.
    """

    def __init__(self, context: TabContext, done: Callable[[Path], object]) -> None:
        super().__init__(context)
        self._done = done
        self.out = Path()
        self.step, self.message = _NO_STEP, ""
        self.stopping = self.is_virtual = False
        self._close: Callable[[], object] | None = None
        self._started = False
        self._reason = ""

    def start(self, arguments: Sequence[str], out: Path, *, virtual: bool) -> None:
        """Start a command that writes a folder, unless one is running."""
        if self.running:
            self._context.messages.warn("a verification is still running; cancel it first, or wait for its end")
            return
        try:
            out.mkdir(parents=True, exist_ok=True)
            for name in (LOG_NAME, STOP_NAME):  # of an earlier one
                (out / name).unlink(missing_ok=True)
        except OSError as failure:
            self._context.messages.fault(f"the verification cannot be started: {error_text(failure)}")
            return
        self.out, self._log, self.step, self.message = out, LogTail(out / LOG_NAME), _NO_STEP, ""
        self._started, self._reason, self.stopping, self.is_virtual = False, "", False, virtual
        self.run(
            arguments,
            self._report_end,
            log_file=out / "verify.said",
            name="the verification",
            advice="its outputs ended with it, but the mirror stands where it was: run the verification again",
        )

    def cancel(self) -> None:
        """Stop it: outputs muted, mirror parked."""
        if self.running and not self.stopping:
            self.stopping = True
            if self._started:
                self._request_stop()

    def poll(self) -> None:
        """Read its log; called often."""
        if self.running:
            self._read()

    def closing_question(self) -> ClosingQuestion | None:
        """What to ask before the window closes; None without a verification."""
        if not self.running:
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

    def _read(self) -> bool:
        """Read what is new in its log, a block of it; returns whether there was anything."""
        records = self._log.read()[0]
        for record in records:
            with suppress(MessageError):  # of another version
                self._receive(message_of(record, _MESSAGES))
        return bool(records)

    def _receive(self, message: object) -> None:
        match message:
            case VerifyStarted():
                self._started = True
                if self.stopping:  # cancelled before it could look for the file
                    self._request_stop()
            case VerifyStep():
                self.step = message
            case StateChanged(state=state, reason=reason):
                self.message = "" if state is State.RUNNING else reason
            case Fault(instrument=name, cause=what) | ReconnectTried(instrument=name, outcome=what):
                self.message = f"{name}: {what}"
            case VerifyEnded(reason=reason):
                self._reason = reason

    def _request_stop(self) -> None:
        try:
            (self.out / STOP_NAME).touch()
        except OSError as failure:
            self.stopping = False
            self._context.messages.fault(f"the verification cannot be stopped: {error_text(failure)}")

    def _report_end(self, process: CommandProcess) -> None:
        while self._read():
            pass
        self.stopping = False
        with suppress(OSError):
            (self.out / STOP_NAME).unlink(missing_ok=True)
        stopped = "stopped; the outputs are muted and the mirror is parked; Verify goes on with what was scanned"
        judged = process.exit_code in (Exit.DONE, Exit.NOT_GOOD_ENOUGH)
        why = f"Not good enough. {self._reason}" if judged else self._reason
        self._context.report_end(process, f"Verified. {self._reason}", stopped, why)
        if judged:
            self._done(self.out / RECORD_NAME)
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
