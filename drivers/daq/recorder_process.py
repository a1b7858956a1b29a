"""The process that runs NI-DAQmx: what its library keeps broken after a replug ends with it.

Run as ``python -P -m drivers.daq.recorder_process`` with pipes for input and output; see `process_recorder`.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from dataclasses import asdict
from queue import SimpleQueue
from typing import Any

from drivers.daq.ni_recorder import NiRecorder
from drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from drivers.identity import DeviceIdentity
from drivers.message_pipe import Message, MessagePipe
from drivers.protocols import RecordRequest, Take

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
