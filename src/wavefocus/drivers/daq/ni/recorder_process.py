"""An NI device on this computer as a recorder, with NI-DAQmx in a process of its own."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from dataclasses import dataclass, replace
from queue import SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.drivers.daq.ni.calls import CALL_S, CalledProcess, ProcessCall, carry_out, next_call
from wavefocus.drivers.daq.ni.ni_recorder import NiRecorder
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.process import OPENING_S, MessagePipe, pipe_to_parent
from wavefocus.drivers.protocols import DeviceIdentity, Recording, RecordRequest

CLOSING_S = 3.0
"""Closing a task in a library that hangs does not return; then the process just ends."""


@dataclass(frozen=True, slots=True)
class RecorderOpening:
    """What `NiRecorder` is made of: its arguments, the device that must answer, and whether it was ours before."""

    wiring: dict[str, Any]
    identity: DeviceIdentity | None
    owned: bool


class ProcessRecorder:
    """Records reference and response; implements `wavefocus.drivers.protocols.Recorder`.

    Raises InstrumentLostError or InstrumentError.

    device: Name in NI MAX: ``"Dev1"``.
    reference_input, response_input, terminal, trigger, resets: See `wavefocus.drivers.daq.ni.ni_recorder.NiRecorder`.
    """

    def __init__(
        self,
        device: str,
        *,
        reference_input: str,
        response_input: str,
        terminal: str,
        trigger: str | None,
        resets: bool = True,
    ) -> None:
        self._instrument = f"recorder {device}"
        self._wiring: dict[str, Any] = {
            "device": device,
            "reference_input": reference_input,
            "response_input": response_input,
            "terminal": terminal,
            "trigger": trigger,
            "resets": resets,
        }
        self._identity: DeviceIdentity | None = None
        self._owned = False
        self._ranges_v: tuple[float, ...] = ()
        self._connecting = threading.Lock()
        self._closed = False
        self._process: CalledProcess | None = None
        self._open("opening")

    @property
    def process_id(self) -> int | None:
        """The process that runs NI-DAQmx; None where there is none."""
        return None if self._process is None else self._process.pid

    @property
    def identity(self) -> DeviceIdentity:
        assert self._identity is not None  # since it was opened
        return self._identity

    @property
    def input_ranges_v(self) -> tuple[float, ...]:
        return self._ranges_v

    def identify(self) -> str:
        return str(self._call("identifying", "identify"))

    def start(self, request: RecordRequest) -> None:
        self._call(f"starting {request.label}", "start", request)

    def read(self, timeout_s: float) -> Recording:
        recording = self._call("reading", "read", timeout_s, limit_s=CALL_S + timeout_s)
        assert isinstance(recording, Recording)
        return recording

    def read_input_v(self, name: str) -> float:
        """Volts at another input, see `wavefocus.drivers.daq.ni.ni_recorder.NiRecorder.read_input_v`."""
        return float(self._call(f"reading {name}", "read_input_v", name))

    def record_inputs_v(self, names: tuple[str, str], samples: int, sample_rate_hz: float) -> NDArray[np.float64]:
        """See `wavefocus.drivers.protocols.RecordsInputs`."""
        limit_s = CALL_S + samples / sample_rate_hz
        doing = f"recording {names[0]} and {names[1]}"
        volts = self._call(doing, "record_inputs_v", names, samples, sample_rate_hz, limit_s=limit_s)
        return np.asarray(volts, dtype=np.float64)

    def sampling_delay_s(self, sample_rate_hz: float) -> float | None:
        """See `wavefocus.drivers.protocols.StatesDelay`."""
        delay_s = self._call("asking for its conversion rate", "sampling_delay_s", sample_rate_hz)
        return None if delay_s is None else float(delay_s)

    def abort(self) -> None:
        if self._process is not None and not self._closed:
            with suppress(InstrumentLostError):  # with the process, its record has ended too
                self._call("aborting", "abort")

    def reconnect(self) -> None:
        """End the process that runs NI-DAQmx, start a fresh one, and open the same device in it.

        Raises InstrumentLostError or InstrumentError.
        """
        self._check_open("reconnecting")
        with self._connecting:
            self._end()
            self._open("reconnecting")

    def close(self) -> None:
        self._closed = True
        with self._connecting:
            self._end()

    def _open(self, doing: str) -> None:
        name = "the process that runs NI-DAQmx"
        self._process = CalledProcess(self._instrument, "wavefocus.drivers.daq.ni.recorder_process", name)
        try:
            opening = RecorderOpening(self._wiring, self._identity, self._owned)
            self._identity, self._ranges_v = self._call(doing, "open", opening, limit_s=OPENING_S)
        except BaseException:
            self._end()
            raise

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.close()

    def _call(self, doing: str, method: str, *arguments: Any, limit_s: float = CALL_S) -> Any:
        """Have a method called there and wait for its end."""
        self._check_open(doing)
        process = self._process
        if process is None:
            raise InstrumentLostError(self._instrument, doing, "it is not connected", "reconnect first")
        answer = process.ask(doing, method, *arguments, limit_s=limit_s)
        # A device that could not be opened may still be reserved by what was before.
        self._owned = self._owned or answer.owned
        return answer.value()

    def _check_open(self, doing: str) -> None:
        if self._closed:
            raise InstrumentError(self._instrument, doing, "it is closed", "open the rig again")


def main() -> None:
    """Carry out calls until the parent closes the pipe; the process ends here."""
    served = _Served(pipe_to_parent())
    threading.Thread(target=served.work, daemon=True).start()
    served.take_calls()
    threading.Event().wait(CLOSING_S)
    os._exit(0)


class _Served:
    """The recorder of this process: one call after the other, but for reads, during which others come."""

    def __init__(self, pipe: MessagePipe) -> None:
        self._pipe = pipe
        self._recorder: NiRecorder | None = None
        self._waiting: SimpleQueue[ProcessCall | None] = SimpleQueue()

    def take_calls(self) -> None:
        while isinstance(call := next_call(self._pipe), ProcessCall):
            if call.method == "read":
                threading.Thread(target=self._carry_out, args=(call,), daemon=True).start()
            else:
                self._waiting.put(call)
        self._waiting.put(None)

    def work(self) -> None:
        while (call := self._waiting.get()) is not None:
            self._carry_out(call)
        if self._recorder is not None:
            self._recorder.close()
        os._exit(0)

    def _carry_out(self, call: ProcessCall) -> None:
        answer = carry_out(call, self._call)
        self._pipe.try_send(replace(answer, owned=self._recorder is not None and self._recorder.owned))

    def _open(self, opening: RecorderOpening) -> tuple[DeviceIdentity, tuple[float, ...]]:
        self._recorder = NiRecorder(**opening.wiring, address=None, identity=opening.identity, owned=opening.owned)
        return self._recorder.identity, self._recorder.input_ranges_v

    def _call(self, call: ProcessCall) -> Any:
        if call.method == "open":
            return self._open(*call.arguments)
        return getattr(self._recorder, call.method)(*call.arguments)
