"""One NI box and the driver's bookkeeping about it: the cable, the tasks, who has reserved it."""

from __future__ import annotations

import threading
import time

from mocks.wire.ni import ni_errors
from mocks.wire.ni.ni_errors import NiError
from mocks.wire.ni.ni_products import PRODUCTS, Product
from mocks.wire.ni.ni_tasks import NiTask, SignalSource, State


class NiBox:
    """The box; thread-safe.

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
        self._reserved: NiTask | None = None
        self._absent_until_s: float | None = None

    # -- hands on the hardware -----------------------------------------------------------------

    def unplug(self, seconds: float = 0.0) -> None:
        """Pull the cable, for good or for some seconds; what runs is lost."""
        with self.condition:
            self._absent_until_s = time.monotonic() + seconds if seconds else float("inf")
            self._break_all()

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
        """Abort what runs and take every reservation back."""
        with self.condition:
            self.touch(name)
            for task in self._tasks.values():
                task.commits = False
                task.end()
            self._reserved = None

    def touch(self, name: str) -> None:
        """What every call does that needs the box itself; raises `NiError` where it is not there."""
        with self.condition:
            if name != self.name:
                raise NiError(ni_errors.NO_SUCH_DEVICE, f"Device: {name}")
            if self._absent_until_s is not None:
                if time.monotonic() < self._absent_until_s:
                    raise NiError(ni_errors.UNPLUGGED, f"Device: {name}")
                self._absent_until_s = None

    def input_number(self, wanted: str) -> int:
        """Number of an input such as ``"ai1"``; raises `NiError` where the box has none of that name."""
        inputs = [f"ai{number}" for number in range(self.product.inputs)]
        if wanted not in inputs:
            raise NiError(ni_errors.NO_SUCH_INPUT, f"Physical Channel: {wanted}")
        return inputs.index(wanted)

    # -- tasks -----------------------------------------------------------------------------------

    @property
    def task_names(self) -> tuple[str, ...]:
        """Names of all tasks."""
        with self.condition:
            return tuple(self._tasks)

    def create(self, name: str) -> NiTask:
        """A new task; without a name it gets one."""
        with self.condition:
            name = name or f"_unnamedTask<{self._made:X}>"
            self._made += 1
            if name in self._tasks:
                raise NiError(ni_errors.DUPLICATE_TASK, f"Task Name: {name}")
            self._tasks[name] = NiTask(name, self.condition, self._source, self._speed)
            return self._tasks[name]

    def clear(self, name: str) -> None:
        """End a task and forget it; works on broken ones too."""
        with self.condition:
            task = self._named(name)
            task.commits = False
            task.end()
            self.release(task)
            del self._tasks[name]

    def task(self, name: str, *, at_rest: bool = False) -> NiTask:
        """The task of a call; one that lost its box says so, one that runs does not take changes."""
        with self.condition:
            task = self._named(name)
            if task.broken is not None:
                raise task.broken
            if at_rest and task.state is State.RUNNING:
                raise NiError(ni_errors.TASK_RUNNING)
            return task

    def reserve(self, task: NiTask) -> None:
        """Take the inputs for one task; they serve one at a time."""
        with self.condition:
            self.touch(self.name)
            if self._reserved not in (None, task):
                raise NiError(ni_errors.IN_USE, f"Device: {self.name}")
            self._reserved = task

    def release(self, task: NiTask) -> None:
        """Give the inputs back, if that task had them."""
        with self.condition:
            if self._reserved is task:
                self._reserved = None

    def _named(self, name: str) -> NiTask:
        task = self._tasks.get(name)
        if task is None:
            raise NiError(ni_errors.INVALID_TASK, f"Task Name: {name}")
        return task

    def _break_all(self) -> None:
        for task in self._tasks.values():
            task.end(NiError(ni_errors.UNPLUGGED, f"Device: {self.name}"))
        self._reserved = None
