"""An NI device on this computer as a recorder, with NI-DAQmx in a process of its own.

After a device was unplugged and plugged in again, properties of the nidaqmx package may fail until the process that
has loaded NI's library ends (an open issue of nidaqmx-python). So every reconnection starts a fresh one; a call that
hangs in the library is ended with it.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from itertools import count
from queue import SimpleQueue
from typing import Any

import numpy as np

from drivers.daq.ni_recorder import NiRecorder
from drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from drivers.process import OPENING_S, DriverProcess, Message, MessagePipe, ProcessGoneError
from drivers.protocols import DeviceIdentity, Recording, RecordRequest, Take

CALL_S = 15.0
"""A call to a device that is well takes milliseconds; a first task, or a reset, takes seconds."""

REMEDY = "check its USB cable and its power, then connect again, which starts NI-DAQmx afresh"
ERRORS: dict[str, type[InstrumentError]] = {
    kind.__name__: kind for kind in (InstrumentError, InstrumentLostError, TransientInstrumentError)
}


class ProcessRecorder:
    """Records reference and response; implements `drivers.protocols.Recorder`.

    Parameters
    ----------
    device : str
        Name in NI MAX: ``"Dev1"``.
    reference_input, response_input, terminal, trigger
        As of `drivers.daq.ni_recorder.NiRecorder`.

    Raises
    ------
    InstrumentLostError
        The device is not there.
    InstrumentError
        A package, the driver, a device of that name, an input or a terminal configuration is missing.
    """

    def __init__(
        self, device: str, *, reference_input: str, response_input: str, terminal: str, trigger: str | None
    ) -> None:
        self._instrument = f"recorder {device}"
        self._wiring = {
            "device": device,
            "reference_input": reference_input,
            "response_input": response_input,
            "terminal": terminal,
            "trigger": trigger,
        }
        self._identity: DeviceIdentity | None = None
        self._owned = False
        self._ranges_v: tuple[float, ...] = ()
        self._numbers = count(1)
        self._connecting = threading.Lock()
        self._closed = False
        self._life: _Life | None = None
        self._open("opening")

    @property
    def process_id(self) -> int | None:
        """The process that runs NI-DAQmx; None where there is none."""
        return None if self._life is None else self._life.process.pid

    @property
    def identity(self) -> DeviceIdentity:
        """Product and serial number of the device."""
        assert self._identity is not None  # known since it was opened
        return self._identity

    @property
    def input_ranges_v(self) -> tuple[float, ...]:
        """Input ranges that the device has, ascending; none where it does not say."""
        return self._ranges_v

    def identify(self) -> str:
        """Product, serial number, driver version and inputs of the device."""
        return str(self._call("identifying", "identify")[0]["text"])

    def start(self, request: RecordRequest) -> None:
        """Start one finite record and return at once. Raises InstrumentError."""
        self._call(
            f"starting {request.take}",
            "start",
            samples=request.samples,
            sample_rate_hz=request.sample_rate_hz,
            range_v=request.range_v,
            take=asdict(request.take),
        )

    def read(self, timeout_s: float) -> Recording:
        """Wait for the record to end and fetch it. Raises InstrumentError after `timeout_s`."""
        told, payload = self._call("reading", "read", CALL_S + timeout_s, timeout_s=timeout_s)
        volts = np.frombuffer(bytearray(payload), dtype=np.float32).reshape(2, -1)
        step_v, over_range = told["volts_per_count"], told["over_range"]
        return Recording(volts, (step_v[0], step_v[1]), (over_range[0], over_range[1]))

    def read_input_v(self, name: str) -> float:
        """Volts at another input, see `drivers.daq.ni_recorder.NiRecorder.read_input_v`."""
        return float(self._call(f"reading {name}", "read input", name=name)[0]["volts"])

    def abort(self) -> None:
        """Drop a record under way; harmless when there is none. A read that waits for it fails."""
        if self._life is not None and not self._closed:
            with suppress(InstrumentLostError):  # with the process, its record has ended too
                self._call("aborting", "abort")

    def reconnect(self) -> None:
        """End the process that runs NI-DAQmx, start a fresh one, and open the same device in it.

        Raises
        ------
        InstrumentLostError
            The device is not there (yet).
        InstrumentError
            Another device answers in its place, or the recorder was closed.
        """
        self._check_open("reconnecting")
        with self._connecting:
            self._end()
            self._open("reconnecting")

    def close(self) -> None:
        """Release the device. Safe to call twice."""
        self._closed = True
        with self._connecting:
            self._end()

    # -- inside --------------------------------------------------------------------------------------

    def _open(self, doing: str) -> None:
        self._life = _Life()
        try:
            known = None if self._identity is None else asdict(self._identity)
            told, _ = self._call(doing, "open", OPENING_S, wiring=self._wiring, identity=known, owned=self._owned)
        except BaseException:
            self._end()
            raise
        self._identity, self._ranges_v = DeviceIdentity(**told["identity"]), tuple(told["ranges_v"])

    def _end(self) -> None:
        life, self._life = self._life, None
        if life is not None:
            with suppress(ProcessGoneError):
                life.process.send(({"do": "close"}, b""))
            life.process.close()

    def _call(self, doing: str, order: str, limit_s: float = CALL_S, **content: Any) -> tuple[Message, bytes]:
        """Have an order carried out and wait for its end."""
        self._check_open(doing)
        life = self._life
        if life is None:
            raise InstrumentLostError(self._instrument, doing, "it is not connected", "reconnect first")
        number = next(self._numbers)
        try:
            life.process.send(({"do": order, "number": number, **content}, b""))
            answer = life.process.wait_for(lambda: life.answers.get(number), time.monotonic() + limit_s)
        except ProcessGoneError as gone:
            raise InstrumentLostError(self._instrument, doing, gone.cause, REMEDY) from None
        if answer is None:
            cause = f"NI-DAQmx did not answer within {limit_s:g} s"
            life.process.kill(cause)
            raise InstrumentLostError(self._instrument, doing, cause, REMEDY)
        del life.answers[number]
        told, _ = answer
        # A device that could not be opened may still be reserved by what was before.
        self._owned = self._owned or bool(told["owned"])
        if told["is"] == "failed":
            failure = ERRORS[told["kind"]](*told["what"])
            for note in told["notes"]:
                failure.add_note(note)
            raise failure
        return answer

    def _check_open(self, doing: str) -> None:
        if self._closed:
            raise InstrumentError(self._instrument, doing, "it is closed", "open the rig again")


class _Life:
    """One life of the process, and what it answered."""

    def __init__(self) -> None:
        self.answers: dict[int, tuple[Message, bytes]] = {}
        self.process = DriverProcess("drivers.daq.recorder_process", "the process that runs NI-DAQmx", {}, self._note)

    def _note(self, message: Message, payload: bytes) -> None:
        if "number" in message:
            self.answers[message["number"]] = (message, payload)


CLOSING_S = 3.0
"""Closing a task in a library that hangs does not return; then the process just ends."""

KINDS = (InstrumentLostError, TransientInstrumentError, InstrumentError)


def main() -> None:
    """Do what comes over the pipe until it ends."""
    # Ctrl-C reaches every process of a terminal; the parent decides what stops, and when.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # NI's library prints where it pleases; the answers go where nothing else does.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    _Orders(MessagePipe(sys.stdin.buffer, answers)).obey()


class _Orders:
    """Carries out the parent's orders: one after the other, but for reads, during which others come."""

    def __init__(self, pipe: MessagePipe) -> None:
        self._pipe = pipe
        self._recorder: NiRecorder | None = None
        self._waiting: SimpleQueue[Message | None] = SimpleQueue()

    def obey(self) -> None:
        """Take orders until one says to close or the parent is gone; the process ends here."""
        threading.Thread(target=self._work, daemon=True).start()
        while (received := self._pipe.receive()) is not None:
            message, _ = received
            if message["do"] == "close":
                break
            if message["do"] == "ask":
                self._send({"is": "here"})
            elif message["do"] == "read":
                threading.Thread(target=self._carry_out, args=(message,), daemon=True).start()
            else:
                self._waiting.put(message)
        self._waiting.put(None)
        threading.Event().wait(CLOSING_S)
        os._exit(0)

    def _work(self) -> None:
        while (message := self._waiting.get()) is not None:
            self._carry_out(message)
        if self._recorder is not None:
            self._recorder.close()
        os._exit(0)

    def _carry_out(self, message: Message) -> None:
        number, order = message["number"], message["do"]
        try:
            content, payload = ORDERS[order](self, message)
        except InstrumentError as failure:
            kind = next(kind for kind in KINDS if isinstance(failure, kind))
            content, payload = _failure(kind, failure), b""
        except Exception:  # a defect: what the parent keeps of standard error tells where
            traceback.print_exc()
            sys.stderr.flush()
            os._exit(4)
        owned = self._recorder is not None and self._recorder.owned
        self._send({"is": "done", "number": number, "owned": owned, **content}, payload)

    def open(self, message: Message) -> tuple[Message, bytes]:
        identity = message["identity"]
        self._recorder = NiRecorder(
            **message["wiring"],
            address=None,
            identity=None if identity is None else DeviceIdentity(**identity),
            owned=message["owned"],
        )
        return {
            "identity": asdict(self._recorder.identity),
            "ranges_v": list(self._recorder.input_ranges_v),
        }, b""

    def identify(self, message: Message) -> tuple[Message, bytes]:
        return {"text": self._opened.identify()}, b""

    def start(self, message: Message) -> tuple[Message, bytes]:
        self._opened.start(
            RecordRequest(
                message["samples"], message["sample_rate_hz"], tuple(message["range_v"]), Take(**message["take"])
            )
        )
        return {}, b""

    def read(self, message: Message) -> tuple[Message, bytes]:
        recording = self._opened.read(message["timeout_s"])
        told = {"volts_per_count": recording.volts_per_count, "over_range": recording.over_range}
        return told, recording.volts.tobytes()

    def read_input(self, message: Message) -> tuple[Message, bytes]:
        return {"volts": self._opened.read_input_v(message["name"])}, b""

    def abort(self, message: Message) -> tuple[Message, bytes]:
        self._opened.abort()
        return {}, b""

    @property
    def _opened(self) -> NiRecorder:
        assert self._recorder is not None
        return self._recorder

    def _send(self, message: Message, payload: bytes = b"") -> None:
        try:
            self._pipe.send(message, payload)
        except OSError:  # the parent is gone; the reading thread sees it too, and ends the process in good order
            return


ORDERS: dict[str, Callable[[_Orders, Message], tuple[Message, bytes]]] = {
    "open": _Orders.open,
    "identify": _Orders.identify,
    "start": _Orders.start,
    "read": _Orders.read,
    "read input": _Orders.read_input,
    "abort": _Orders.abort,
}


def _failure(kind: type[InstrumentError], failure: InstrumentError) -> dict[str, Any]:
    return {
        "is": "failed",
        "kind": kind.__name__,
        "what": [failure.instrument, failure.operation, failure.cause, failure.remedy],
        "notes": getattr(failure, "__notes__", []),
    }


if __name__ == "__main__":
    main()
