"""Calls to NI-DAQmx in a process of its own, at both ends: the recorder and the outputs are called alike.

NI-DAQmx can stay broken after a replug until the process that has loaded it ends (an open issue of nidaqmx-python).
So every connection starts a fresh one, and a call that hangs in the library is ended with it.
"""

from __future__ import annotations

import os
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from typing import Any

from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.process import Alive, Ask, Close, DriverProcess, MessagePipe, ProcessGoneError

CALL_S = 15.0
"""A call to a device that is well takes milliseconds; a ramp up to a second, a first task or a reset seconds."""

REMEDY = "check its USB cable and its power, then connect again, which starts NI-DAQmx afresh"


@dataclass(frozen=True, slots=True)
class ProcessCall:
    """A method that the process is asked to call."""

    number: int
    method: str
    arguments: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class ProcessAnswer:
    """The result of a call, or how it failed; `owned`: the device may be reserved, which a recorder says."""

    number: int
    result: Any
    failure: InstrumentError | None
    owned: bool = False

    def value(self) -> Any:
        """The result. Raises the failure."""
        if self.failure is not None:
            raise self.failure
        return self.result


class CalledProcess:
    """Starts a module's `main` as a process and calls methods in it; safe to use from several threads.

    instrument: Name, for messages.
    module, name: See `wavefocus.drivers.process.DriverProcess`.
    """

    def __init__(self, instrument: str, module: str, name: str) -> None:
        self._instrument = instrument
        self._numbers = count(1)
        self._answers: dict[int, ProcessAnswer] = {}
        self._process = DriverProcess(module, name, self._note)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def ask(self, doing: str, method: str, *arguments: Any, limit_s: float = CALL_S) -> ProcessAnswer:
        """Have a method called there and wait for its end.

        Raises InstrumentLostError where the process is gone, or does not answer in time: then it is killed.
        """
        number = next(self._numbers)
        try:
            self._process.send(ProcessCall(number, method, arguments))
            answer = self._process.wait_for(lambda: self._answers.get(number), time.monotonic() + limit_s)
        except ProcessGoneError as gone:
            raise InstrumentLostError(self._instrument, doing, gone.cause, REMEDY) from None
        if answer is None:
            cause = f"NI-DAQmx did not answer within {limit_s:g} s"
            self._process.kill(cause)
            raise InstrumentLostError(self._instrument, doing, cause, REMEDY)
        del self._answers[number]
        return answer

    def close(self) -> None:
        """End the process, which releases its device."""
        self._process.close()

    def _note(self, message: object) -> None:
        if isinstance(message, ProcessAnswer):
            self._answers[message.number] = message


def next_call(pipe: MessagePipe) -> ProcessCall | Close | None:
    """In the process: wait for a call, and give signs of life meanwhile; None when the parent is gone."""
    while isinstance(message := pipe.receive(), Ask):
        pipe.try_send(Alive())
    call: ProcessCall | Close | None = message
    return call


def carry_out(call: ProcessCall, served: Callable[[ProcessCall], Any]) -> ProcessAnswer:
    """In the process: the answer to a call. A defect ends the process with its traceback, which the parent keeps."""
    try:
        return ProcessAnswer(call.number, served(call), None)
    except InstrumentError as failure:
        return ProcessAnswer(call.number, None, failure)
    except Exception:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(4)
