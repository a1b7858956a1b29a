"""NI-DAQmx in a process of its own: its recorder and its outputs, called as if they were here.

Outputs are analog ones that are written together, or a digital line; they are written at once, without a clock. An
output keeps its level when its task ends, until it is written again, the device is reset or loses its power.

NI-DAQmx can stay broken after a replug until the process that has loaded it ends (an open issue of nidaqmx-python).
So every connection to the driver of this computer starts a fresh one, and a call that hangs in the library is ended
with it. Outputs behind a server are opened afresh in the process that has them.
"""

import math
import os
import sys
import threading
import time
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count
from queue import SimpleQueue
from typing import Any, Literal

import numpy as np

from wavefocus.drivers.daq.ni import NiSession
from wavefocus.drivers.daq.ni.ni_recorder import NiRecorder
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.process import (
    ALIVE,
    ASK,
    AT_REST,
    CLOSE,
    OPENING_S,
    DriverProcess,
    ProcessGoneError,
    pipe_to_parent,
    wait_for_silence,
)
from wavefocus.drivers.protocols import DeviceIdentity, Recorder, Recording, RecordRequest, WallClock

_RAMP_STEP_S = 1e-3
"""Time between two steps of a ramp; a write over USB takes about as long."""


@dataclass(frozen=True, slots=True)
class OutputSettings:
    """Outputs of one device.

    role: Table of the rig file that names them.
    key: Its keys that name the outputs.
    kind: Analog outputs, or one digital line.
    names: ``("ao0", "ao1")`` or ``("port1/line0",)``.
    rest: Volts, or 0 and 1, to leave them at.
    limit_v, slew_v_per_s: Largest voltage to either side, and its fastest change; of analog outputs.
    """

    role: Literal["mirror", "shutter"]
    key: str
    kind: Literal["analog", "digital"]
    device: str
    address: str | None
    names: tuple[str, ...]
    rest: tuple[float, ...]
    limit_v: float = 10.0
    slew_v_per_s: float = 1e6


_ANSWER_S = 5.0


class _NiOutputs:
    """Outputs of one device, here; see `OutputSettings`. No other task may have one of them. Raises InstrumentError.

    level: What they are at, as far as that is known; analog outputs cannot be read back.
    identity: The device that must answer, where it has answered before.
    """

    ends_within_s = 10.0

    def __init__(self, settings: OutputSettings, level: tuple[float, ...], identity: DeviceIdentity | None) -> None:
        self._settings, self._level = settings, level
        self._session = session = NiSession(
            settings.device, settings.address, _ANSWER_S, role=settings.role, identity=identity
        )
        doing = "preparing its outputs"
        self._require_outputs(doing)
        with session.explaining(doing):
            self._task = session.new_task()
            try:
                physical = ", ".join(f"{settings.device}/{name}" for name in settings.names)
                if settings.kind == "analog":
                    limit_v = settings.limit_v
                    self._task.ao_channels.add_ao_voltage_chan(physical, min_val=-limit_v, max_val=limit_v)
                else:
                    self._task.do_channels.add_do_chan(physical)
                self._task.start()
            except BaseException:
                with suppress(Exception):  # the first failure is the one to act on
                    self._task.close()
                raise

    def identify(self) -> DeviceIdentity:
        """Ask the device who it is."""
        with self._session.explaining("identifying"):
            return self._session.ask_identity()

    def write(self, level: tuple[float, ...], doing: str) -> None:
        """Put outputs at voltages, no faster than their slew rate, or a line at 0 or 1; return when they are there."""
        if self._settings.kind == "analog":
            self._ramp(level, doing)
        else:
            self._set_line(bool(level[0]), doing)

    def come_to_rest(self) -> None:
        """Write what the settings say for the end."""
        self.write(self._settings.rest, "coming to rest")

    def close(self) -> None:
        """Release the outputs; each keeps its level."""
        with suppress(InstrumentError), self._session.explaining("closing"):
            self._task.close()
        self._session.close()

    def _require_outputs(self, doing: str) -> None:
        """Refuse names that the device has not."""
        device, session = self._settings.device, self._session
        with session.explaining(doing):
            there = session.handle.ao_physical_chans if self._settings.kind == "analog" else session.handle.do_lines
            known = [name.removeprefix(f"{device}/") for name in there.channel_names]
        for name in self._settings.names:
            if name not in known:
                cause = f"{session.identity.product} has no output {name!r}"
                remedy = f"{self._settings.key}: there is {', '.join(known) or 'no output of this kind'}"
                raise InstrumentError(session.instrument, doing, cause, remedy)

    def _ramp(self, volts: tuple[float, ...], doing: str) -> None:
        from nidaqmx.stream_writers import AnalogMultiChannelWriter

        clock = WallClock()
        due_s = clock.now_s()
        # The last one also where nothing changes, for the device may have lost its power.
        for step_v in _ramp_steps(self._level, volts, self._settings.slew_v_per_s) or [volts]:
            clock.sleep(due_s - clock.now_s())
            with self._session.explaining(doing):
                writer = AnalogMultiChannelWriter(self._task.out_stream, auto_start=True)
                writer.verify_array_shape = False  # it would ask the device for the number of channels each time
                writer.write_one_sample(np.asarray(step_v, dtype=np.float64))
            self._level = step_v
            due_s = max(due_s, clock.now_s()) + _RAMP_STEP_S

    def _set_line(self, level: bool, doing: str) -> None:
        """Put a line high or low, and read it back. Raises InstrumentError: it reads otherwise."""
        from nidaqmx.stream_readers import DigitalSingleChannelReader
        from nidaqmx.stream_writers import DigitalSingleChannelWriter

        with self._session.explaining(doing):
            DigitalSingleChannelWriter(self._task.out_stream, auto_start=True).write_one_sample_one_line(level)
            found = DigitalSingleChannelReader(self._task.in_stream).read_one_sample_one_line()
        if bool(found) != level:
            was, reads = ("high", "low") if level else ("low", "high")
            cause = f"{self._settings.names[0]} was set {was} and reads {reads}"
            raise InstrumentError(self._session.instrument, doing, cause, "check what is wired to the line")


def _ramp_steps(start_v: Sequence[float], stop_v: Sequence[float], slew_v_per_s: float) -> list[tuple[float, ...]]:
    """Voltages of a straight ramp, `_RAMP_STEP_S` apart, its last step at the end; none where nothing changes.

    slew_v_per_s: Fastest change of any output, > 0.
    """
    way_v = max(abs(stop - start) for start, stop in zip(start_v, stop_v, strict=True))
    count = math.ceil(way_v / (slew_v_per_s * _RAMP_STEP_S) - 1e-9)
    return [
        tuple(start + (stop - start) * step / count for start, stop in zip(start_v, stop_v, strict=True))
        for step in range(1, count + 1)
    ]


_CALL_S = 15.0
"""A call to a device that is well takes milliseconds; a ramp up to a second, a first task or a reset seconds."""

_REMEDY = "check its USB cable and its power, then connect again, which starts NI-DAQmx afresh"


class _InProcess:
    """A device that is opened and called in a process of its own; safe to use from several threads.

    Calls go there as number, method and arguments; its answers are number, result, failure, and whether the device may
    be reserved, which a recorder says. Calls raise InstrumentLostError or InstrumentError.

    name: What the process is, for messages.
    """

    def __init__(self, instrument: str, name: str) -> None:
        self._instrument, self._name = instrument, name
        self._identity: DeviceIdentity | None = None
        self._owned = self._connected = self.closed = False
        self._process: DriverProcess | None = None
        self._connecting = threading.Lock()
        self._numbers = count(1)
        self._answers: dict[int, tuple[Any, InstrumentError | None, bool]] = {}

    @property
    def identity(self) -> DeviceIdentity:
        """Who it is; known since it was opened for the first time."""
        assert self._identity is not None
        return self._identity

    @property
    def process_id(self) -> int | None:
        """The process that runs NI-DAQmx; None where there is none."""
        return None if self._process is None else self._process.pid

    def require_open(self, doing: str) -> None:
        """Raise InstrumentError once it is closed."""
        if self.closed:
            raise InstrumentError(self._instrument, doing, "it is closed", "open the rig again")

    def close(self) -> None:
        """Release the device for good; twice does no harm."""
        self.closed = True
        with self._connecting:
            self._end()

    def _open(self, doing: str, kind: str, *arguments: Any, again: bool = False) -> Any:
        """Make a `kind` in a fresh process; returns what it answers to "open".

        again: Make it in the process that is there, where it lives.
        """
        self.require_open(doing)
        with self._connecting:
            self._connected = False
            if not again or self._process is None or self._process.gone:
                self._end()
                self._process = DriverProcess(__name__, self._name, self._note)
            try:
                answer = self._call(doing, "open", kind, *arguments, limit_s=OPENING_S)
            except BaseException:
                if not again:
                    self._end()
                raise
            self._connected = True
            return answer

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.close()

    def _call(self, doing: str, method: str, *arguments: Any, limit_s: float = _CALL_S) -> Any:
        """Have a method called there and wait for its end; a process that does not answer in time is killed."""
        self.require_open(doing)
        process, number = self._process, next(self._numbers)
        if process is None or not (self._connected or method == "open"):
            raise InstrumentLostError(self._instrument, doing, "it is not connected", "reconnect first")
        try:
            process.send((number, method, arguments))
            # A process that is starting loads its packages first, which takes seconds on a slow disk.
            until_s, asks = time.monotonic() + limit_s, method != "open"
            answer = process.wait_for(lambda: self._answers.get(number), until_s, asks=asks)
            if answer is None:
                process.kill(f"NI-DAQmx did not answer within {limit_s:g} s")
                raise ProcessGoneError(process.gone)
        except ProcessGoneError as gone:
            remedy = "connect again" if process.at_rest else _REMEDY
            raise InstrumentLostError(self._instrument, doing, str(gone), remedy) from None
        result, failure, owned = self._answers.pop(number)
        # A device that could not be opened may still be reserved by what was before.
        self._owned = self._owned or owned
        if failure is not None:
            raise failure
        return result

    def _note(self, message: Any) -> None:
        if message != ALIVE:
            self._answers[message[0]] = message[1:]


class ProcessRecorder(_InProcess, Recorder):
    """Records reference and response in a process of its own.

    device: Name in NI MAX: ``"Dev1"``.
    wiring: As for `wavefocus.drivers.daq.ni.ni_recorder.NiRecorder`.
    """

    def __init__(self, device: str, **wiring: Any) -> None:
        super().__init__(f"recorder {device}", "the process that runs NI-DAQmx")
        self._wiring = {"device": device, "address": None, **wiring}
        self._ranges_v: tuple[float, ...] = ()
        self._connect("opening")

    @property
    def input_ranges_v(self) -> tuple[float, ...]:
        return self._ranges_v

    def identify(self) -> str:
        return str(self._call("identifying", "identify"))

    def start(self, request: RecordRequest) -> None:
        self._call(f"starting {request.label}", "start", request)

    def read(self, timeout_s: float) -> Recording:
        recording: Recording = self._call("reading", "read", timeout_s, limit_s=_CALL_S + timeout_s)
        return recording

    def read_input_v(self, name: str) -> float:
        """Volts at another input, see `wavefocus.drivers.daq.ni.ni_recorder.NiRecorder.read_input_v`."""
        return float(self._call(f"reading {name}", "read_input_v", name))

    def sampling_delay_s(self, sample_rate_hz: float) -> float | None:
        delay_s: float | None = self._call("asking for its conversion rate", "sampling_delay_s", sample_rate_hz)
        return delay_s

    def abort(self) -> None:
        if self._process is not None and not self.closed:
            with suppress(InstrumentLostError):  # with the process, its record has ended too
                self._call("aborting", "abort")

    def reconnect(self) -> None:
        """Open the same device in a fresh process. Raises InstrumentLostError or InstrumentError."""
        self._connect("reconnecting")

    def _connect(self, doing: str) -> None:
        arguments = self._wiring | {"identity": self._identity, "owned": self._owned}
        self._identity, self._ranges_v = self._open(doing, "recorder", arguments)


class ProcessOutputs(_InProcess):
    """Outputs that are written together, in a process that `open` starts.

    label: What the outputs are called behind the device's product in `identity`: ``"line port1/line0"``.
    level: What the outputs are at, where that is known: a ramp begins there.
    """

    def __init__(self, instrument: str, settings: OutputSettings, label: str, level: Sequence[float] = ()) -> None:
        super().__init__(instrument, "the process that has it")
        self._settings, self._label, self._level = settings, label, tuple(level)

    def open(self, doing: str) -> None:
        """Open the outputs, also afresh; the device is not reset, for the recorder may have it, too.

        Raises InstrumentLostError: it does not answer. InstrumentError: it is misspelt, refuses, is another device than
        before, or the outputs were closed.
        """
        if self._process is not None and self._process.at_rest:
            self._level = self._settings.rest
        again = self._settings.address is not None and self._identity is not None
        self._identity = self._open(doing, "outputs", self._settings, self._level, self._identity, again=again)

    @property
    def identity(self) -> DeviceIdentity:
        device = super().identity
        return replace(device, product=f"{device.product} {self._label}")

    def identify(self) -> DeviceIdentity:
        """Ask the device who it is."""
        identity: DeviceIdentity = self._call("identifying", "identify")
        return identity

    def write(self, level: Sequence[float], doing: str) -> None:
        """Put outputs at voltages, no faster than their slew rate, or a line at 0 or 1; return when they are there."""
        self._call(doing, "write", tuple(level), doing)
        self._level = tuple(level)


def main() -> None:
    """Carry out calls until the parent says close, or is gone or stopped: then outputs come to rest first."""
    pipe, waiting = pipe_to_parent(), SimpleQueue[Any]()
    device: NiRecorder | _NiOutputs | None = None

    def carry_out(number: int, method: str, arguments: tuple[Any, ...]) -> None:
        nonlocal device
        result, failure = None, None
        try:
            if method != "open":
                result = getattr(device, method)(*arguments)
            elif arguments[0] == "recorder":
                device = NiRecorder(**arguments[1])
                result = device.identity, device.input_ranges_v
            else:
                if device is not None:
                    device.close()
                    device = None
                device = _NiOutputs(*arguments[1:])
                result = device.identify()
        except InstrumentError as refused:
            failure = refused
        except Exception:  # a defect: the parent keeps standard error
            traceback.print_exc()
            sys.stderr.flush()
            os._exit(4)
        pipe.try_send((number, result, failure, isinstance(device, NiRecorder) and device.owned))

    def work() -> None:
        while (message := waiting.get()) not in (None, CLOSE, AT_REST):
            carry_out(*message)
        if device is not None:
            with suppress(InstrumentError):
                if isinstance(device, _NiOutputs) and message != CLOSE:  # the parent is gone without a word
                    device.come_to_rest()
            device.close()
        if message == AT_REST:
            pipe.try_send(message)
        os._exit(0)

    def watch() -> None:
        wait_for_silence(pipe)
        if not isinstance(device, NiRecorder):  # has nothing to put to rest
            waiting.put(AT_REST)

    for part in (work, watch):
        threading.Thread(target=part, daemon=True).start()
    while (message := pipe.receive()) not in (None, CLOSE):
        if message == ASK:
            pipe.try_send(ALIVE)
        elif message != ALIVE and message[1] == "read":  # others come meanwhile
            threading.Thread(target=carry_out, args=message, daemon=True).start()
        elif message != ALIVE:
            waiting.put(message)
    waiting.put(message)
    # What hangs in the library does not return; then the process just ends.
    threading.Event().wait(0.0 if device is None else device.ends_within_s)
    os._exit(0)
