"""Orders to a live session: read from JSON objects, and kept, bounded, until the next block is computed."""

import threading
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path

from msgspec.structs import replace

from wavefocus.config.fields import Table
from wavefocus.config.loading import validated
from wavefocus.config.messages.live import ORDERS, EndLive, EndSource, MoveSource, SetSignal
from wavefocus.config.scene import SignalTable
from wavefocus.console import one_line
from wavefocus.json_lines import read_order
from wavefocus.rendering.live.engine import MAX_NAME
from wavefocus.rendering.live.lives import Emitted, emitted_by
from wavefocus.rendering.scene.model import build_signal
from wavefocus.storage.errors import InputError

MAX_WAITING = 1000


@dataclass(frozen=True, slots=True)
class UseSignal:
    """The order `SetSignal` as the session carries it out; the samples are made before, so that no block waits."""

    name: str
    emitted: Emitted


Order = MoveSource | UseSignal | EndSource | EndLive


class _SignalOrder(Table):
    signal: SignalTable


def order_of(content: Mapping[str, object], rate_hz: float, folder: Path) -> Order:
    """Read an order.

    rate_hz: The bank's, at which signals are made.
    folder: Where a relative name of a sound file begins.

    Raises InputError: a key or value is wrong, or a signal cannot be made.
    """
    order = read_order(content, ORDERS)
    if isinstance(order, MoveSource | EndSource | SetSignal):
        check_name(order.name)
    if isinstance(order, SetSignal):
        table = validated(_SignalOrder, {"signal": order.signal}, "order signal")
        signal = build_signal(table.signal, folder / "order signal", "signal")
        return UseSignal(order.name, emitted_by(signal, rate_hz, repeat=order.repeat))
    assert isinstance(order, MoveSource | EndSource | EndLive)
    return order


def check_name(name: str) -> None:
    """Refuse a name that is empty or too long. Raises InputError."""
    if not 0 < len(name) <= MAX_NAME:
        raise InputError(f"name is {one_line(repr(name), 80)}; allowed: 1 to {MAX_NAME} characters")


@dataclass(slots=True)
class Waiting:
    """An order that waits; of positions merged into one, the arrival of the first.

    answers: End when it was applied.
    """

    order: Order
    arrived_s: float
    answers: list[Future[None]]

    def end(self, refusal: Exception | None = None) -> None:
        """Say that it was applied, or why not."""
        for answer in self.answers:
            if refusal is None:
                answer.set_result(None)
            else:
                answer.set_exception(refusal)


class Inbox:
    """Orders from any thread to the one that computes.

    All that come within a block take effect together. Of positions of one source in a row the newest counts, so that a
    flood of them takes no memory and delays nothing.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: list[Waiting] = []
        self._latest: dict[str, Waiting] = {}
        self.positions = 0

    def put(self, order: Order, arrived_s: float, *answers: Future[None]) -> None:
        """Add an order that arrived at this instant, of `time.monotonic`. Raises InputError: too many wait."""
        with self._lock:
            name = "" if isinstance(order, EndLive) else order.name
            latest = self._latest.get(name)
            if isinstance(order, MoveSource):
                self.positions += 1
                if latest is not None and isinstance(latest.order, MoveSource):
                    amplitude = latest.order.amplitude if order.amplitude is None else order.amplitude
                    latest.order = replace(order, amplitude=amplitude)
                    latest.answers.extend(answers)
                    return
            if len(self._waiting) >= MAX_WAITING and not isinstance(order, EndLive):
                raise InputError(f"more than {MAX_WAITING} orders came within a block; this one is left out")
            self._latest[name] = waiting = Waiting(order, arrived_s, list(answers))
            self._waiting.append(waiting)

    def take(self) -> list[Waiting]:
        """All that waits, in order; nothing waits then."""
        with self._lock:
            taken, self._waiting = self._waiting, []
            self._latest = {}
        return taken
