"""One NI box and NI-DAQmx's bookkeeping about it: error codes, the cable, the tasks and who has reserved it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from enum import IntEnum
from typing import Protocol

import numpy as np

from wavefocus.drivers.protocols import Float64Array
from wavefocus.mocks.virtual import NANOSECONDS
from wavefocus.mocks.wire.ni_products import PRODUCTS, Channel, Product

Alive = Callable[[], bool]

# How often a wait looks whether its caller is still there.
_POLL_S = 0.05


class NiCode(IntEnum):
    """Codes of NI-DAQmx, as the nidaqmx package and the header NIDAQmx.h have them, each with its text."""

    text: str

    def __new__(cls, code: int, text: str) -> NiCode:
        one = int.__new__(cls, code)
        one._value_, one.text = code, text
        return one

    INVALID_VALUE = -200077, "Requested value is not a supported value for this property."
    SAMPLE_RATE_TOO_HIGH = -200081, "Sample rate, number of channels and convert period do not go together."
    INVALID_TASK = -200088, "Task specified is invalid or does not exist."
    DUPLICATE_TASK = -200089, "Task name conflicts with an existing task name."
    NO_SUCH_INPUT = -200170, "Physical channel specified does not exist on this device."
    NO_SUCH_DEVICE = -200220, "Device identifier is invalid."
    OVERWRITTEN = -200279, "The application is not able to keep up with the hardware acquisition; data was overwritten."
    NOT_YET_AVAILABLE = -200284, ""
    NOT_STARTED = -200278, "Samples will never be available: the task has ended or was never started."
    NOT_SUPPORTED = -200452, "Attribute is not supported in this context."
    NO_CHANNELS = -200478, "Operation cannot be performed because there are no channels in the task."
    TASK_RUNNING = -200479, "Operation cannot be performed while the task is running."
    NOT_DONE = -200560, "Wait Until Done did not indicate that the task was done within the specified timeout."
    UNPLUGGED = -201003, "Device cannot be accessed: it may be unplugged, off or in reset."
    ABSENT = -88705, "Specified device is not present or is not active in the system."
    ABORTED = -88709, "Task was aborted while the operation was under way."
    NO_SUCH_TERMINAL = -89120, "Source terminal to be routed could not be found on the device."
    IN_USE = -50103, "The specified resource is reserved. The operation could not be completed as specified."
    TRANSFER_ABORTED = -50405, "The transfer was aborted on the bus."
    STOPPED_BEFORE_DONE = 200010, "Finite acquisition was stopped before all requested samples were acquired."
    ADC_OVERLOADED = 200005, "The analog-to-digital converter was overloaded."
    SOFTWARE_ERROR = -229771, "Internal Software Error occurred in MIG software."  # in no list; from public reports
    NOT_CALIBRATED = 200016, "The device was never self-calibrated with NI-DAQmx."


class NiError(Exception):
    """An NI-DAQmx error code on its way to the client."""

    def __init__(self, code: NiCode, detail: str = "") -> None:
        super().__init__(" ".join(part for part in (code.text, detail, f"Status Code: {code:d}") if part))
        self.code = int(code)


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
        self.outputs: list[str] = []
        """Analog outputs or digital lines, in order; a task has inputs or outputs."""
        self.running = False
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
        self.running = True
        self._started += 1
        self._read = 0
        self._start_ns = None if self.trigger else time.monotonic_ns()
        self._condition.notify_all()

    def edge(self, terminal: str) -> None:
        """A rising edge at a terminal."""
        if self.running and self.trigger == terminal and self._start_ns is None:
            self._start_ns = time.monotonic_ns()
            self._condition.notify_all()

    def end(self, broken: NiError | None = None) -> bool:
        """Stop, for good where `broken` says why; returns whether samples were still to come."""
        early = self.running and self.acquired() < self.samples
        self.broken = self.broken or broken
        self.running = False
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
    def resources(self) -> tuple[str, ...]:
        """What no other task may have: the one converter of the inputs, or each output."""
        return tuple(self.outputs) or ("inputs",)

    @property
    def unread(self) -> int:
        """Samples per channel that are waiting to be read."""
        return self.acquired() - self._read

    def wait_done(self, timeout_s: float, alive: Alive) -> None:
        """Return when every sample of a finite record has been, or raise."""
        if not self.running:
            return
        if not self._wait(self.samples, timeout_s, alive):
            raise NiError(NiCode.NOT_DONE)

    def read(self, samples: int, timeout_s: float, alive: Alive) -> tuple[Float64Array, bool]:
        """Volts of the next samples, shape (channels, samples or fewer), and whether all came in time.

        Waits up to `timeout_s`, for ever where that is negative.
        """
        if not self.running:
            raise NiError(NiCode.NOT_STARTED)
        if self._read + samples > self.samples:
            raise NiError(NiCode.NOT_STARTED, f"The task has {self.samples - self._read} left.")
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
        return np.stack([channel.converted(row) for channel, row in zip(self.channels, analog_v, strict=True)])

    def _wait(self, acquired: int, timeout_s: float, alive: Alive) -> bool:
        """Whether this number of samples was there in time; raises when the task ends meanwhile."""
        until_s = time.monotonic() + timeout_s if timeout_s >= 0 else float("inf")
        started = self._started
        while self.acquired() < acquired:
            left_s = until_s - time.monotonic()
            if left_s <= 0:
                return False
            if not alive():
                raise NiError(NiCode.ABORTED)
            self._condition.wait(min(left_s, _POLL_S, self._due_s(acquired)))
            self._check(started)
        return True

    def _due_s(self, acquired: int) -> float:
        """How long until this number of samples has been taken; for ever where the trigger has not come."""
        if self._start_ns is None:
            return float("inf")
        end_ns = self._start_ns + acquired / self.rate_hz / self._speed * NANOSECONDS
        return max(1e-4, (end_ns - time.monotonic_ns()) / NANOSECONDS)

    def _check(self, started: int) -> None:
        if self.broken is not None:
            raise self.broken
        if not self.running or self._started != started:
            raise NiError(NiCode.ABORTED)


class NiBox:
    """The box; what has to do with tasks is called with `condition` held.

    source: What is at the inputs.
    name: Device name: ``"Dev1"``.
    serial_number: As NI-DAQmx gives it.
    speed: How much faster than real time samples come, > 0.
    """

    def __init__(self, source: SignalSource, product: str, name: str, serial_number: int, speed: float) -> None:
        self.product: Product = PRODUCTS[product]
        self.name = name
        self.serial_number = serial_number
        self.condition = threading.Condition(threading.RLock())
        self._source = source
        self._speed = speed
        self._tasks: dict[str, NiTask] = {}
        self._made = 0
        self._reserved: dict[str, NiTask] = {}
        self._levels: dict[str, float] = {}
        self.output_changed: Callable[[Mapping[str, float]], object] = lambda levels: None
        """Called with the levels of all outputs, in volts or 0 and 1, when one has changed."""
        self._absent_until_s: float | None = None

    # -- hands on the hardware -----------------------------------------------------------------

    def unplug(self, seconds: float = 0.0) -> None:
        """Pull the cable, for good or for some seconds; what runs is lost, and the outputs fall to 0 V."""
        with self.condition:
            self._absent_until_s = time.monotonic() + seconds if seconds else float("inf")
            self._break_all()
            self._drop_outputs()

    def plug(self) -> None:
        """Put the cable back; tasks from before stay broken."""
        with self.condition:
            self._absent_until_s = None

    def forget(self) -> None:
        """The driver's process ends: its tasks are gone."""
        with self.condition:
            self._break_all()
            self._tasks.clear()

    def edge(self, terminal: str) -> None:
        """A rising edge at a digital input such as ``"PFI0"``."""
        with self.condition:
            for task in self._tasks.values():
                task.edge(terminal)

    def reset(self, name: str) -> None:
        """Abort what runs, take every reservation back, and put all outputs to 0 V."""
        self.touch(name)
        for task in self._tasks.values():
            task.commits = False
            task.end(NiError(NiCode.ABORTED) if task.outputs else None)
        self._reserved.clear()
        self._drop_outputs()

    def touch(self, name: str) -> None:
        """What every call does that needs the box itself; raises `NiError` where it is not there."""
        if name != self.name:
            raise NiError(NiCode.NO_SUCH_DEVICE, f"Device: {name}")
        if self._absent_until_s is not None:
            if time.monotonic() < self._absent_until_s:
                raise NiError(NiCode.UNPLUGGED, f"Device: {name}")
            self._absent_until_s = None

    def input_number(self, wanted: str) -> int:
        """Number of an input such as ``"ai1"``; raises `NiError` where the box has none of that name."""
        number = wanted.removeprefix("ai")
        if f"ai{number}" != wanted or not number.isdecimal() or int(number) >= self.product.inputs:
            raise NiError(NiCode.NO_SUCH_INPUT, f"Physical Channel: {wanted}")
        return int(number)

    # -- tasks -----------------------------------------------------------------------------------

    @property
    def task_names(self) -> tuple[str, ...]:
        """Names of all tasks."""
        return tuple(self._tasks)

    def create(self, name: str) -> NiTask:
        """A new task; without a name it gets one."""
        name = name or f"_unnamedTask<{self._made:X}>"
        self._made += 1
        if name in self._tasks:
            raise NiError(NiCode.DUPLICATE_TASK, f"Task Name: {name}")
        self._tasks[name] = NiTask(name, self.condition, self._source, self._speed)
        return self._tasks[name]

    def clear(self, name: str) -> None:
        """End a task and forget it; works on broken ones too."""
        task = self._named(name)
        task.commits = False
        task.end()
        self.release(task)
        del self._tasks[name]

    def task(self, name: str, *, at_rest: bool = False) -> NiTask:
        """The task of a call; one that lost its box says so, one that runs does not take changes."""
        task = self._named(name)
        if task.broken is not None:
            raise task.broken
        if at_rest and task.running:
            raise NiError(NiCode.TASK_RUNNING)
        return task

    def reserve(self, task: NiTask) -> None:
        """Take the inputs, or some outputs, for one task; they serve one at a time."""
        self.touch(self.name)
        if any(self._reserved.get(resource) not in (None, task) for resource in task.resources):
            raise NiError(NiCode.IN_USE, f"Device: {self.name}")
        self._reserved.update(dict.fromkeys(task.resources, task))

    def release(self, task: NiTask) -> None:
        """Give back what that task had."""
        self._reserved = {name: other for name, other in self._reserved.items() if other is not task}

    # -- outputs -----------------------------------------------------------------------------------

    @property
    def output_names(self) -> tuple[str, ...]:
        """Analog outputs and digital lines."""
        return (*(f"ao{number}" for number in range(self.product.outputs)), *self.product.lines)

    def level(self, name: str) -> float:
        """Volts at an analog output, 0 or 1 at a digital line; an output keeps its level when its task ends."""
        return self._levels.get(name, 0.0)

    def set_levels(self, levels: Mapping[str, float]) -> None:
        """Put voltages, or 0 and 1, at some outputs."""
        self._levels.update(levels)
        self.output_changed(dict(self._levels))

    def _drop_outputs(self) -> None:
        if self._levels:
            self.set_levels(dict.fromkeys(self._levels, 0.0))

    def _named(self, name: str) -> NiTask:
        task = self._tasks.get(name)
        if task is None:
            raise NiError(NiCode.INVALID_TASK, f"Task Name: {name}")
        return task

    def _break_all(self) -> None:
        for task in self._tasks.values():
            task.end(NiError(NiCode.UNPLUGGED, f"Device: {self.name}"))
        self._reserved.clear()
