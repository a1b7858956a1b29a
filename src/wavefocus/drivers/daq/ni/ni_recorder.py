"""National Instruments' data acquisition devices as recorders, through the nidaqmx package."""

import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from wavefocus.drivers.daq.ni import REPEAT, NiSession, Tls
from wavefocus.drivers.daq.ni.ni_task import (
    InputWiring,
    RecordTask,
    TaskTiming,
    check_wiring,
    conversion_delay_s,
)
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.protocols import DeviceIdentity, Recorder, Recording, RecordRequest

_ANSWER_S = 5.0
"""How long a server may take to answer beyond what a call asks for, in s."""

_SINGLE_ENDED_V = 10.0
"""Where a device has larger ranges too, as the USB-6008 and 6009, they are of differential inputs alone."""

# One period of the mains at 50 Hz.
_INPUT_TIMING = TaskTiming(5000.0, 100, (10.0, 10.0))


def _in_widest_range(timing: TaskTiming, session: NiSession) -> TaskTiming:
    """The same in the device's widest range: not every one has 10 V, an NI 9234 ends at 5 V."""
    widest_v = max(session.limits.ranges_v or timing.range_v)
    return replace(timing, range_v=(widest_v, widest_v))


class NiRecorder(Recorder):
    """Records reference and response.

    The low-cost devices cannot start on an audio signal: without a trigger a record starts at once, and where the
    sound lies in it is found from the reference. The task is kept committed between records of one kind, so that a
    start is one call; no other program can have the device meanwhile. Raises InstrumentLostError or InstrumentError.

    device: Name in NI MAX: ``"Dev1"``.
    address: ``"host:port"`` of NI's gRPC Device Server; None for the NI-DAQmx driver on this computer.
    reference_input, response_input: Analog inputs: ``"ai0"``.
    terminal: ``"differential"``, ``"rse"``, ``"nrse"`` or ``"pseudodifferential"``.
    trigger: Digital input whose rising edge starts a record: ``"PFI0"``; None or empty to start at once.
    answer_s: How long a server may take to answer beyond what a call asks for, in s, > 0.
    identity: The device that must answer, where it has answered before.
    owned: Whether this program had the device before: it is reset then, see `reconnect`.
    resets: Whether it may be reset at all. A reset puts every output of the device to 0 V: it is not, where a mirror or
        a shutter hangs on them.
    tls: For a server with a certificate.
    task_name: A name that only this recorder uses on its server: what a killed process of this name has left reserved
        is taken back. Empty: it stays reserved.
    """

    ends_within_s = 3.0

    def __init__(
        self,
        device: str,
        *,
        address: str | None,
        reference_input: str,
        response_input: str,
        terminal: str,
        trigger: str | None,
        answer_s: float = _ANSWER_S,
        identity: DeviceIdentity | None = None,
        owned: bool = False,
        resets: bool = True,
        tls: Tls | None = None,
        task_name: str = "",
    ) -> None:
        self._session_with: Callable[..., NiSession] = partial(
            NiSession, device, address or None, answer_s, tls=tls, task_name=task_name
        )
        self._where = f"{device} at {address}" if address else f"{device} on this computer"
        self._resets = resets
        self._wiring = InputWiring((reference_input, response_input), terminal, trigger or None)
        self._lock = threading.RLock()
        self._task: RecordTask | None = None
        self._under_way: RecordRequest | None = None
        self._closed = False
        self._owned = owned  # whether it may have reserved the device: what is left reserved may be its own then
        self._session: NiSession | None = None
        self._session = session = self._opened(identity)
        self._instrument, self._identity = session.instrument, session.identity
        try:
            check_wiring(session, self._wiring)
        except BaseException:
            session.close()
            raise

    @property
    def identity(self) -> DeviceIdentity:
        return self._identity

    @property
    def owned(self) -> bool:
        """Whether this recorder may have reserved the device."""
        return self._owned

    def identify(self) -> str:
        """Product, serial number, driver version, address and inputs of the device."""
        with self._lock:
            session = self._connected("identifying")
            with session.explaining("identifying"):
                identity = session.ask_identity()
            inputs = " and ".join(self._wiring.inputs)
            return f"{identity}, {self._where}, NI-DAQmx {session.driver_version}, {inputs} {self._wiring.terminal}"

    @property
    def input_ranges_v(self) -> tuple[float, ...]:
        with self._lock:
            known = None if self._session is None else self._session.limits.ranges_v
            return () if known is None else tuple(sorted(known))

    def start(self, request: RecordRequest) -> None:
        doing = f"starting {request.label}"
        with self._lock:
            session = self._connected(doing)
            if self._under_way is not None:
                raise InstrumentError(self._instrument, doing, "a record is under way", "read or abort it first")
            timing = TaskTiming(request.sample_rate_hz, request.samples, request.range_v)
            try:
                with session.explaining(doing):
                    self._ready(session, timing, doing).start()
            except BaseException as failure:  # an interruption too leaves a task in an unknown state
                self._discard(failure)
                raise
            finally:
                self._owned = session.owned
            self._under_way = request

    def read(self, timeout_s: float) -> Recording:
        with self._lock:
            session = self._connected("reading")
            request, task = self._under_way, self._task
        if request is None or task is None:
            raise InstrumentError(self._instrument, "reading", "no record was started", "start one first")
        doing = f"recording {request.label}"
        try:
            # Without the lock: another thread may abort.
            with session.explaining(doing):
                done = task.wait(timeout_s)
            with self._lock:
                self._check_goes_on(request, doing)
                if not done:
                    raise self._unfinished(timeout_s, doing)
                with session.explaining(doing):
                    volts, count = task.read()
                    task.stop()
                self._under_way = None
        except InstrumentError as failure:
            with self._lock:
                self._check_goes_on(request, doing)
                if not isinstance(failure, _UnfinishedError):
                    self._under_way = None
                    self._discard(failure)
            raise
        if count < request.samples or not np.isfinite(volts).all():
            cause = f"samples are missing: only {count} of {request.samples} came"
            raise TransientInstrumentError(self._instrument, doing, cause, REPEAT)
        return _recording(volts, task)

    def read_input_v(self, name: str) -> float:
        """Volts at another input, the mean over 20 ms, so that no hum is left; between two records.

        Raises InstrumentError.

        name: ``"ai2"``, wired as the others are.
        """
        doing, wiring = f"reading {name}", InputWiring((name, self._wiring.inputs[1]), self._wiring.terminal, None)
        # The record, and 2 s for the driver to begin and end it.
        limit_s = _INPUT_TIMING.samples / _INPUT_TIMING.rate_hz + 2.0
        with self._lock:
            session = self._connected(doing)
            if self._under_way is not None:
                raise InstrumentError(self._instrument, doing, "a record is under way", "read or abort it first")
            task, self._task = self._task, None
            with session.explaining(doing):
                if task is not None:
                    task.close()  # what is committed holds the converter
                short = RecordTask(session, wiring, _in_widest_range(_INPUT_TIMING, session), doing, exact=False)
                try:
                    short.start()
                    done = short.wait(limit_s)
                    volts, _ = short.read() if done else (np.full((2, 1), np.nan), 0)
                finally:
                    short.close()
                    self._owned = session.owned
        if not np.isfinite(volts).all():
            raise TransientInstrumentError(self._instrument, doing, f"not finished after {limit_s:g} s", REPEAT)
        return float(volts[0].mean())

    def sampling_delay_s(self, sample_rate_hz: float) -> float | None:
        """By the rate of the device's conversion clock."""
        doing = "asking for its conversion rate"
        with self._lock:
            session = self._connected(doing)
            if session.limits.simultaneous:
                return 0.0
            timing = _in_widest_range(replace(_INPUT_TIMING, rate_hz=sample_rate_hz), session)
            with session.explaining(doing):
                return conversion_delay_s(session, self._wiring, timing)

    def abort(self) -> None:
        """Drop a record under way; harmless when there is none. A read that waits for it fails."""
        with self._lock:
            if self._under_way is None:
                return
            self._under_way = None
            if self._session is None or self._task is None:
                return
            try:
                with self._session.explaining("aborting"):
                    self._task.stop()
            except InstrumentError as failure:
                # Aborting is safe from any state. The next start makes a new task, and meets what is wrong here.
                self._discard(failure)

    def reconnect(self) -> None:
        """Drop the connection and open a fresh one to the same device.

        The device is reset, if it was ours before: that takes back what a lost session has left reserved, and ends
        a transfer that hangs. It also ends what other programs run on this device, so nothing here does it before
        this recorder had the device. Raises InstrumentLostError or InstrumentError.
        """
        doing = "reconnecting"
        with self._lock:
            self._check_open(doing)
            with suppress(InstrumentError):  # the reset takes back what cannot be cleared any more
                self._drop(doing)
            self._session = self._opened(self._identity)

    def close(self) -> None:
        """Release the device. Safe to call twice; what is lost anyway is released in silence."""
        with self._lock:
            self._closed = True
            with suppress(InstrumentLostError):
                self._drop("closing")

    def _opened(self, identity: DeviceIdentity | None) -> NiSession:
        """A session with the device, reset where it may be and was ours before."""
        session = self._session_with(identity=identity, owned=self._owned)
        if self._wiring.terminal in ("rse", "nrse"):
            inside_v = tuple(range_v for range_v in session.limits.ranges_v or () if range_v <= _SINGLE_ENDED_V)
            session.limits = replace(session.limits, ranges_v=inside_v or session.limits.ranges_v)
        try:
            if self._owned and self._resets:
                with session.explaining("resetting the device"):
                    session.handle.reset_device()
        except BaseException:
            session.close()
            raise
        return session

    def _ready(self, session: NiSession, timing: TaskTiming, doing: str) -> RecordTask:
        """The task for a record: the one of the record before where that was of the same kind."""
        if self._task is not None and self._task.timing != timing:
            task, self._task = self._task, None
            task.close()
        if self._task is None:
            self._task = RecordTask(session, self._wiring, timing, doing)
        return self._task

    def _drop(self, doing: str) -> None:
        """Let go of task and connection, whatever state they are in."""
        self.abort()
        session, self._session = self._session, None
        task, self._task = self._task, None
        if session is None:
            return
        try:
            if task is not None:
                with session.explaining(doing):
                    task.close()
        finally:
            session.close()

    def _discard(self, failure: BaseException) -> None:
        """Clear the task after a failure."""
        task, self._task = self._task, None
        if task is not None:
            task.close_after(failure)

    def _check_open(self, doing: str) -> None:
        if self._closed:
            raise InstrumentError(self._instrument, doing, "it is closed", "open the rig again")

    def _connected(self, doing: str) -> NiSession:
        self._check_open(doing)
        if self._session is None:
            raise InstrumentLostError(self._instrument, doing, "it is not connected", "reconnect first")
        return self._session

    def _check_goes_on(self, request: RecordRequest, doing: str) -> None:
        """Let a read fail: its record was dropped meanwhile."""
        if self._under_way is not request:
            raise TransientInstrumentError(self._instrument, doing, "it was aborted", "start it again")

    def _unfinished(self, timeout_s: float, doing: str) -> InstrumentError:
        remedy = "allow the length of the record"
        if self._wiring.trigger:
            remedy += f", and check that a rising edge reaches {self._wiring.trigger}"
        return _UnfinishedError(self._instrument, doing, f"not finished after {timeout_s:g} s", remedy)


class _UnfinishedError(TransientInstrumentError):
    """The record goes on, and can still be read."""


def _recording(volts: NDArray[np.float64], task: RecordTask) -> Recording:
    rounded = np.empty(volts.shape, dtype=np.float32)
    reference, response = task.converters
    over_range = (reference.quantise(volts[0], rounded[0]), response.quantise(volts[1], rounded[1]))
    return Recording(rounded, (reference.step_v, response.step_v), over_range)
