"""Tasks of the emulated NI-DAQmx: channels, timing, trigger, the states between, and the samples."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mocks.virtual.surroundings import NANOSECONDS
from mocks.wire.ni import ni_errors
from mocks.wire.ni.ni_errors import NiError
from mocks.wire.ni.ni_products import Converter

Float64Array = NDArray[np.float64]
Alive = Callable[[], bool]

# How often a wait looks whether its caller is still there.
POLL_S = 0.05


class SignalSource(Protocol):
    """The analog world at the inputs."""

    def record(
        self, start_ns: int, samples: int, rate_hz: float, inputs: tuple[str, ...], channel_delay_s: float
    ) -> Float64Array:
        """Analog volts, noise included, shape (inputs, samples).

        start_ns: Instant of the first sample, of `time.monotonic_ns`.
        inputs: Physical inputs such as ``("ai0", "ai1")``.
        channel_delay_s: Input k is sampled k times this later.
        """
        ...


class State(Enum):
    """States of a task."""

    IDLE = "idle"
    COMMITTED = "committed"
    RUNNING = "running"


@dataclass(frozen=True, slots=True)
class Channel:
    """One voltage channel: its name in the task, its input (``"ai0"``) and its converter."""

    name: str
    input: str
    converter: Converter


class NiTask:
    """One task; its state changes under the device's condition, which the callers hold.

    name: As the client calls it.
    condition: Of the device; notified when anything changes.
    source: What is at the inputs.
    speed: How much faster than the clock on the wall the samples come, > 0.
    """

    def __init__(self, name: str, condition: threading.Condition, source: SignalSource, speed: float) -> None:
        self.name = name
        self.channels: list[Channel] = []
        self.rate_hz = 0.0
        self.samples = 0
        self.trigger = ""
        self.channel_delay_s = 0.0
        self.state = State.IDLE
        self.commits = False  # asked to stay committed between starts
        self.broken: NiError | None = None
        self._condition = condition
        self._source = source
        self._speed = speed
        self._start_ns: int | None = None
        self._started = 0  # starts so far: a wait sees by it that its record is gone
        self._read = 0

    def begin(self) -> None:
        """Start, at once or armed for the trigger's edge."""
        self.state = State.RUNNING
        self._started += 1
        self._read = 0
        self._start_ns = None if self.trigger else time.monotonic_ns()
        self._condition.notify_all()

    def edge(self, terminal: str) -> None:
        """A rising edge at a terminal."""
        if self.state is State.RUNNING and self.trigger == terminal and self._start_ns is None:
            self._start_ns = time.monotonic_ns()
            self._condition.notify_all()

    def end(self, broken: NiError | None = None) -> bool:
        """Stop, for good where `broken` says why; returns whether samples were still to come."""
        early = self.state is State.RUNNING and self.acquired() < self.samples
        self.broken = self.broken or broken
        self.state = State.COMMITTED if self.commits and broken is None else State.IDLE
        self._start_ns = None
        self._condition.notify_all()
        return early

    def acquired(self) -> int:
        """Samples per channel since the start."""
        if self._start_ns is None:
            return 0
        elapsed_s = (time.monotonic_ns() - self._start_ns) / NANOSECONDS * self._speed
        return min(int(elapsed_s * self.rate_hz), self.samples)

    @property
    def unread(self) -> int:
        """Samples per channel that are waiting to be read."""
        return self.acquired() - self._read

    def wait_done(self, timeout_s: float, alive: Alive) -> None:
        """Return when every sample of a finite record has been, or raise."""
        if self.state is not State.RUNNING:
            return
        if not self._wait(self.samples, timeout_s, alive):
            raise NiError(ni_errors.NOT_DONE)

    def read(self, samples: int, timeout_s: float, alive: Alive) -> tuple[Float64Array, bool]:
        """Volts of the next samples, shape (channels, samples or fewer), and whether all came in time.

        Waits up to `timeout_s`, for ever where that is negative.
        """
        if self.state is not State.RUNNING:
            raise NiError(ni_errors.NOT_STARTED)
        if self._read + samples > self.samples:
            raise NiError(ni_errors.NOT_STARTED, f"The task has {self.samples - self._read} left.")
        complete = self._wait(self._read + samples, timeout_s, alive)
        first, count = self._read, min(samples, self.unread)
        self._read += count
        if not count or self._start_ns is None:
            return np.zeros((len(self.channels), 0)), complete
        start_ns = self._start_ns + round(first / self.rate_hz * NANOSECONDS)
        inputs = tuple(channel.input for channel in self.channels)
        started = self._started
        self._condition.release()  # the source may take as long as the sound does
        try:
            analog_v = self._source.record(start_ns, count, self.rate_hz, inputs, self.channel_delay_s)
        finally:
            self._condition.acquire()
        self._check(started)
        return np.asarray(analog_v, dtype=np.float64), complete

    def converted(self, analog_v: Float64Array) -> Float64Array:
        """Analog voltages of all channels as the driver reports them."""
        return np.stack([channel.converter.volts(row) for channel, row in zip(self.channels, analog_v, strict=True)])

    def _wait(self, acquired: int, timeout_s: float, alive: Alive) -> bool:
        """Whether so many samples were there in time; raises when the task ends meanwhile."""
        until_s = time.monotonic() + timeout_s if timeout_s >= 0 else float("inf")
        started = self._started
        while self.acquired() < acquired:
            left_s = until_s - time.monotonic()
            if left_s <= 0:
                return False
            if not alive():
                raise NiError(ni_errors.ABORTED)
            self._condition.wait(min(left_s, POLL_S, self._due_s(acquired)))
            self._check(started)
        return True

    def _due_s(self, acquired: int) -> float:
        """How long until so many samples have been; for ever where the trigger has not come."""
        if self._start_ns is None:
            return float("inf")
        end_ns = self._start_ns + acquired / self.rate_hz / self._speed * NANOSECONDS
        return max(1e-4, (end_ns - time.monotonic_ns()) / NANOSECONDS)

    def _check(self, started: int) -> None:
        if self.broken is not None:
            raise self.broken
        if self.state is not State.RUNNING or self._started != started:
            raise NiError(ni_errors.ABORTED)
