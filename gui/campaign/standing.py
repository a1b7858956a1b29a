"""How the followed campaign stands, and which orders make sense then."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from acquisition.engine.events import State

GOING = frozenset(
    {State.RUNNING, State.PAUSING, State.PAUSED, State.SUSPENDED, State.RECOVERING, State.STOPPING},
)
OVER = frozenset({State.IDLE, State.STOPPED, State.FINISHED, State.FAILED})


class Extra(StrEnum):
    """What a window sees and a capture does not say of itself."""

    NO_BANK = "no bank"
    WAITING = "waiting for the bank"
    STARTING = "starting"
    PREPARING = "preparing"
    SILENT = "silent"
    GONE = "gone"


@dataclass(frozen=True, slots=True)
class Standing:
    """How a campaign stands.

    Parameters
    ----------
    word : State or Extra
        In a word.
    reason : str
        Why.
    """

    word: State | Extra
    reason: str = ""

    @property
    def measuring(self) -> bool:
        """Whether a process is at it, in whatever state."""
        return self.word in GOING or self.word in (Extra.STARTING, Extra.PREPARING, Extra.SILENT)


class Order(StrEnum):
    """What can be asked for, as the buttons have it."""

    START = "start"
    PAUSE = "pause"
    GO_ON = "go-on"
    STOP = "stop"
    RESUME = "resume"
    REMEASURE = "remeasure"


_WHILE: dict[State | Extra, frozenset[Order]] = {
    State.RUNNING: frozenset({Order.PAUSE, Order.STOP}),
    State.RECOVERING: frozenset({Order.PAUSE, Order.STOP}),
    State.PAUSING: frozenset({Order.GO_ON, Order.STOP}),
    State.PAUSED: frozenset({Order.GO_ON, Order.STOP}),
    State.SUSPENDED: frozenset({Order.PAUSE, Order.STOP}),
    State.STOPPING: frozenset(),
    Extra.STARTING: frozenset(),
    Extra.PREPARING: frozenset({Order.STOP}),
    Extra.SILENT: frozenset({Order.STOP}),
}


def possible(standing: Standing, *, has_run: bool, has_bank: bool, left: int) -> frozenset[Order]:
    """Orders that make sense.

    Parameters
    ----------
    standing : Standing
        How the campaign stands.
    has_run : bool
        Whether a run file and a bank to write are named.
    has_bank : bool
        Whether there is a bank with a campaign in it.
    left : int
        Positions of the bank that are not measured.
    """
    if standing.measuring:
        return _WHILE[standing.word]
    orders = set()
    if has_run:
        orders.add(Order.START)
    if has_bank:
        orders.add(Order.REMEASURE)
        if left:
            orders.add(Order.RESUME)
    return frozenset(orders)
