"""Outputs of an NI device in a process of their own, which puts them to rest when the program is gone.

NI-DAQmx can stay broken after a replug until the process that has loaded it ends: every connection starts a fresh one.
"""

from __future__ import annotations

import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from queue import SimpleQueue
from typing import Any, Literal

from wavefocus.drivers.daq.ni.ni_outputs import AnalogOutputs, DigitalLine
from wavefocus.drivers.daq.ni.ni_session import NiSession
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.process import (
    OPENING_S,
    Alive,
    Ask,
    Close,
    DriverProcess,
    MessagePipe,
    ProcessGoneError,
    pipe_to_parent,
)
from wavefocus.drivers.protocols import DeviceIdentity, WallClock

ANSWER_S = 5.0
CALL_S = 15.0
"""A call to a device that is well takes milliseconds; a ramp up to a second."""
REST_S = 10.0
"""Longest time that the outputs may take to come to rest when the program is gone."""
REMEDY = "check its USB cable and its power, then connect again, which starts NI-DAQmx afresh"


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


@dataclass(frozen=True, slots=True)
class OutputCall:
    """What the process is asked to do: ``"open"``, ``"identify"`` or ``"write"``."""

    number: int
    method: str
    arguments: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class OutputAnswer:
    """What came of a call."""

    number: int
    result: Any
    failure: InstrumentError | None


class ProcessOutputs:
    """Outputs that are written together; the process that has them is started here.

    Raises InstrumentLostError or InstrumentError.

    level: What the outputs were put at last, where that is known: a ramp begins there.
    known: Whether the device has answered before: then it is gone where it does not answer, and not misspelt.
    """

    def __init__(
        self, instrument: str, settings: OutputSettings, level: Sequence[float], doing: str, *, known: bool
    ) -> None:
        self._instrument = instrument
        self._numbers = count(1)
        self._answers: dict[int, OutputAnswer] = {}
        self._process = DriverProcess("wavefocus.drivers.daq.ni.outputs_process", "the process that has it", self._note)
        self.level = tuple(level)
        try:
            self.identity: DeviceIdentity = self._call(doing, "open", settings, self.level, known, limit_s=OPENING_S)
        except BaseException:
            self._process.close()
            raise

    @property
    def process_id(self) -> int:
        """The process that has the outputs."""
        return self._process.pid

    def identify(self) -> DeviceIdentity:
        """Ask the device who it is."""
        identity: DeviceIdentity = self._call("identifying", "identify")
        return identity

    def write(self, level: Sequence[float], doing: str) -> None:
        """Put outputs at voltages, no faster than their slew rate, or a line at 0 or 1; return when they are there."""
        self._call(doing, "write", tuple(level), doing)
        self.level = tuple(level)

    def close(self) -> None:
        """Release the outputs; each keeps its level."""
        self._process.close()

    def _note(self, message: object) -> None:
        if isinstance(message, OutputAnswer):
            self._answers[message.number] = message

    def _call(self, doing: str, method: str, *arguments: Any, limit_s: float = CALL_S) -> Any:
        number = next(self._numbers)
        try:
            self._process.send(OutputCall(number, method, arguments))
            answer = self._process.wait_for(lambda: self._answers.get(number), time.monotonic() + limit_s)
        except ProcessGoneError as gone:
            raise InstrumentLostError(self._instrument, doing, gone.cause, REMEDY) from None
        if answer is None:
            cause = f"NI-DAQmx did not answer within {limit_s:g} s"
            self._process.kill(cause)
            raise InstrumentLostError(self._instrument, doing, cause, REMEDY)
        del self._answers[number]
        if answer.failure is not None:
            raise answer.failure
        return answer.result


def main() -> None:
    """Carry out calls until the parent says close, or is gone: then the outputs come to rest first."""
    served = _Served(pipe_to_parent())
    worker = threading.Thread(target=served.work, daemon=True)
    worker.start()
    served.take_calls()
    worker.join(REST_S)
    os._exit(0)


class _Served:
    """The outputs of this process."""

    def __init__(self, pipe: MessagePipe) -> None:
        self._pipe = pipe
        self._settings: OutputSettings | None = None
        self._session: NiSession | None = None
        self._outputs: AnalogOutputs | DigitalLine | None = None
        self._waiting: SimpleQueue[OutputCall | Close | None] = SimpleQueue()

    def take_calls(self) -> None:
        while not isinstance(message := self._pipe.receive(), Close | None):
            if isinstance(message, Ask):
                self._pipe.try_send(Alive())
            else:
                self._waiting.put(message)
        self._waiting.put(message)

    def work(self) -> None:
        while isinstance(message := self._waiting.get(), OutputCall):
            self._carry_out(message)
        with suppress(InstrumentError):
            if message is None and self._settings is not None:  # the program is gone without a word
                self._write(self._settings.rest, "coming to rest")
        with suppress(InstrumentError):
            if self._outputs is not None:
                self._outputs.close()
        if self._session is not None:
            self._session.close()

    def _carry_out(self, call: OutputCall) -> None:
        methods: dict[str, Callable[..., Any]] = {
            "open": self._open,
            "identify": self._identify,
            "write": self._write,
        }
        result, failed = None, None
        try:
            result = methods[call.method](*call.arguments)
        except InstrumentError as failure:
            failed = failure
        except Exception:  # a defect: the parent keeps standard error
            traceback.print_exc()
            sys.stderr.flush()
            os._exit(4)
        self._pipe.try_send(OutputAnswer(call.number, result, failed))

    def _open(self, settings: OutputSettings, level: tuple[float, ...], known: bool) -> DeviceIdentity:
        self._session = session = NiSession(
            settings.device, settings.address, ANSWER_S, role=settings.role, known=known
        )
        if settings.kind == "analog":
            self._outputs = AnalogOutputs(session, settings.names, settings.key, settings.limit_v, level)
        else:
            self._outputs = DigitalLine(session, settings.names, settings.key)
        self._settings = settings
        return session.identity

    def _identify(self) -> DeviceIdentity:
        assert self._session is not None
        with self._session.explaining("identifying"):
            return self._session.ask_identity()

    def _write(self, level: tuple[float, ...], doing: str) -> None:
        assert self._settings is not None
        if isinstance(self._outputs, AnalogOutputs):
            self._outputs.ramp_to(level, self._settings.slew_v_per_s, WallClock(), doing)
        elif self._outputs is not None:
            self._outputs.write(bool(level[0]), doing)
