"""Outputs of an NI device in a process of their own, which puts them to rest when the program is gone."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any, Literal

from wavefocus.drivers.daq.ni.calls import CalledProcess, ProcessCall, carry_out, next_call
from wavefocus.drivers.daq.ni.ni_outputs import AnalogOutputs, DigitalLine
from wavefocus.drivers.daq.ni.ni_session import NiSession
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.process import OPENING_S, Close, MessagePipe, pipe_to_parent
from wavefocus.drivers.protocols import DeviceIdentity, WallClock

ANSWER_S = 5.0
REST_S = 10.0
"""Longest time that the outputs may take to come to rest when the program is gone."""


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


class ProcessOutputs:
    """Outputs that are written together, in a process that `open` starts.

    Its calls raise InstrumentLostError or InstrumentError.

    label: What the outputs are called behind the device's product in `identity`: ``"line port1/line0"``.
    level: What the outputs are at, where that is known: a ramp begins there.
    """

    def __init__(self, instrument: str, settings: OutputSettings, label: str, level: Sequence[float] = ()) -> None:
        self._instrument, self._settings, self._label = instrument, settings, label
        self._level = tuple(level)
        self._process: CalledProcess | None = None
        self._identity: DeviceIdentity | None = None
        self.closed = False

    @property
    def identity(self) -> DeviceIdentity:
        """Device and outputs; known since they were opened for the first time."""
        assert self._identity is not None
        return self._identity

    def open(self, doing: str) -> None:
        """Open the outputs, also afresh; the device is not reset, for the recorder may have it, too.

        Raises InstrumentLostError: it does not answer. InstrumentError: it is misspelt, refuses, is another device than
        before, or the outputs were closed.
        """
        self.require_open(doing)
        self._release()
        known = self._identity
        process = CalledProcess(self._instrument, "wavefocus.drivers.daq.ni.outputs_process", "the process that has it")
        try:
            arguments = (self._settings, self._level, known is not None)
            device: DeviceIdentity = process.ask(doing, "open", *arguments, limit_s=OPENING_S).value()
            identity = DeviceIdentity(device.maker, f"{device.product} {self._label}", device.serial)
            if known is not None and identity != known:
                remedy = "plug the right one in, or start a new campaign with this one"
                raise InstrumentError(self._instrument, doing, f"{identity} answers instead of {known}", remedy)
        except BaseException:
            process.close()
            raise
        self._process, self._identity = process, identity

    def require_open(self, doing: str) -> None:
        """Raise InstrumentError once they are closed."""
        if self.closed:
            raise InstrumentError(self._instrument, doing, "it is closed", "open the rig again")

    def identify(self) -> DeviceIdentity:
        """Ask the device who it is."""
        identity: DeviceIdentity = self._connected("identifying").ask("identifying", "identify").value()
        return identity

    def write(self, level: Sequence[float], doing: str) -> None:
        """Put outputs at voltages, no faster than their slew rate, or a line at 0 or 1; return when they are there."""
        self._connected(doing).ask(doing, "write", tuple(level), doing).value()
        self._level = tuple(level)

    def close(self) -> None:
        """Release the outputs for good; each keeps its level."""
        self.closed = True
        self._release()

    def _release(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.close()

    def _connected(self, doing: str) -> CalledProcess:
        self.require_open(doing)
        if self._process is None:
            raise InstrumentLostError(self._instrument, doing, "it is not connected", "reconnect first")
        return self._process


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
        self._waiting: SimpleQueue[ProcessCall | Close | None] = SimpleQueue()

    def take_calls(self) -> None:
        while isinstance(message := next_call(self._pipe), ProcessCall):
            self._waiting.put(message)
        self._waiting.put(message)

    def work(self) -> None:
        while isinstance(message := self._waiting.get(), ProcessCall):
            self._pipe.try_send(carry_out(message, self._call))
        with suppress(InstrumentError):
            if message is None and self._settings is not None:  # the program is gone without a word
                self._write(self._settings.rest, "coming to rest")
        with suppress(InstrumentError):
            if self._outputs is not None:
                self._outputs.close()
        if self._session is not None:
            self._session.close()

    def _call(self, call: ProcessCall) -> Any:
        methods: dict[str, Callable[..., Any]] = {
            "open": self._open,
            "identify": self._identify,
            "write": self._write,
        }
        return methods[call.method](*call.arguments)

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
