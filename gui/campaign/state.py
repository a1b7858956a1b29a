"""State of the followed campaign, and the orders that make sense in it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from acquisition.engine.events import State

GOING = frozenset(
    {State.RUNNING, State.PAUSING, State.PAUSED, State.SUSPENDED, State.RECOVERING, State.STOPPING},
)
OVER = frozenset({State.IDLE, State.STOPPED, State.FINISHED, State.FAILED})


class Extra(StrEnum):
    """States that only the window sees."""

    NO_BANK = "no bank"
    STARTING = "starting"
    PREPARING = "preparing"
    SILENT = "silent"
    GONE = "gone"


TROUBLED = frozenset({State.FAILED, Extra.GONE, Extra.SILENT})


@dataclass(frozen=True, slots=True)
class CampaignState:
    """A state and its reason."""

    word: State | Extra
    reason: str = ""

    @property
    def measuring(self) -> bool:
        """Whether a process owns the bank, in whatever state."""
        return self.word in _ORDERS


class Order(StrEnum):
    """Orders of the buttons."""

    START = "start"
    PAUSE = "pause"
    CONTINUE = "go-on"
    STOP = "stop"
    RESUME = "resume"
    REMEASURE = "remeasure"


_ORDERS: dict[State | Extra, frozenset[Order]] = {
    State.RUNNING: frozenset({Order.PAUSE, Order.STOP}),
    State.RECOVERING: frozenset({Order.PAUSE, Order.STOP}),
    State.PAUSING: frozenset({Order.CONTINUE, Order.STOP}),
    State.PAUSED: frozenset({Order.CONTINUE, Order.STOP}),
    State.SUSPENDED: frozenset({Order.PAUSE, Order.STOP}),
    State.STOPPING: frozenset(),
    Extra.STARTING: frozenset(),
    Extra.PREPARING: frozenset({Order.STOP}),
    Extra.SILENT: frozenset({Order.STOP}),
}


def possible_orders(state: CampaignState, *, has_run: bool, has_bank: bool, left: int) -> frozenset[Order]:
    """Orders that make sense: `has_run` with a run file and a bank name, `left` positions not measured."""
    if state.measuring:
        return _ORDERS[state.word]
    orders = set()
    if has_run:
        orders.add(Order.START)
    if has_bank:
        orders.add(Order.REMEASURE)
        if left:
            orders.add(Order.RESUME)
    return frozenset(orders)
