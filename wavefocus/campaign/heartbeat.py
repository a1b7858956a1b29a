"""The heartbeat: what a running capture last said of itself, in a small file beside its bank."""

from __future__ import annotations

import os
import socket
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from acquisition.engine.events import (
    Event,
    Fault,
    PositionStarted,
    Progress,
    SessionEnded,
    SessionStarted,
    StateChanged,
)
from wavefocus.campaign.orders import Order
from wavefocus.campaign.sidecar_files import read_whole, write_whole

BEATS_EVERY_S = 1.0
# Silence for longer is worth a word; a machine may be busy for some seconds.
SILENT_AFTER_S = 15.0


def heartbeat_path(bank: Path) -> Path:
    """Where a bank's heartbeat is: ``plate.h5`` -> ``plate.h5.heartbeat``."""
    return bank.with_name(bank.name + ".heartbeat")


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """What a capture says of itself.

    Parameters
    ----------
    at : datetime
        When.
    pid, host : int, str
        Who.
    state, reason, since : str, str, datetime
        Where it stands, why, and since when.
    position : int, optional
        What it measures.
    done, total : int
        Positions.
    remaining_s : float, optional
        On the wall's clock; None before the first position.
    fault : str
        The latest fault in words; empty where there was none.
    order : str
        Number of the latest order that it took; empty where there was none.
    """

    at: datetime
    pid: int
    host: str
    state: str = "idle"
    reason: str = ""
    since: datetime | None = None
    position: int | None = None
    done: int = 0
    total: int = 0
    remaining_s: float | None = None
    fault: str = ""
    order: str = ""

    @property
    def finish_at(self) -> datetime | None:
        """When it will have finished, if nothing holds it up."""
        return None if self.remaining_s is None else self.at + timedelta(seconds=self.remaining_s)

    def age_s(self, now: datetime | None = None) -> float:
        """Seconds since then."""
        return ((now or datetime.now(UTC)) - self.at).total_seconds()


class Pulse:
    """Gathers from a campaign's events what the next beat will say.

    The attributes are replaced one by one; a beat between two of them is right a second later.
    """

    def __init__(self) -> None:
        self._said: dict[str, object] = {}

    def note(self, event: Event) -> bool:
        """Take an event up; tells whether it is worth a beat at once."""
        match event:
            case SessionStarted():
                self._said |= {"done": event.done, "total": event.positions}
            case StateChanged():
                self._said |= {"state": str(event.state), "reason": event.reason, "since": datetime.now(UTC)}
                return True
            case PositionStarted():
                self._said["position"] = event.position
            case Progress():
                self._said |= {"done": event.done, "total": event.total, "remaining_s": event.wall_remaining_s}
            case Fault():
                self._said["fault"] = f"{event.instrument}: {event.operation}: {event.cause}"
            case SessionEnded():
                self._said |= {"done": event.done, "position": None}
                return True
            case _:
                pass
        return False

    def took(self, order: Order) -> None:
        """Let the next beat acknowledge an order."""
        self._said["order"] = order.number

    def beat(self) -> Heartbeat:
        """What there is to say now."""
        return Heartbeat(datetime.now(UTC), os.getpid(), socket.gethostname(), **dict(self._said))  # type: ignore[arg-type]


def write_heartbeat(bank: Path, beat: Heartbeat) -> None:
    """Write a beat.

    Raises
    ------
    OSError
        It cannot be written.
    """
    content = {key: value.isoformat() if isinstance(value, datetime) else value for key, value in asdict(beat).items()}
    finish = beat.finish_at
    write_whole(heartbeat_path(bank), {**content, "finish_at": finish.isoformat() if finish else None})


def read_heartbeat(bank: Path) -> Heartbeat | None:
    """The latest beat; None where there is none that can be read."""
    found = read_whole(heartbeat_path(bank))
    if found is None:
        return None
    found.pop("finish_at", None)
    try:
        at, since = datetime.fromisoformat(str(found.pop("at"))), found.pop("since", None)
        beat = Heartbeat(at, since=None if since is None else datetime.fromisoformat(str(since)), **found)  # type: ignore[arg-type]
        _ = beat.age_s()  # only an instant with a time zone has one
    except (TypeError, ValueError, KeyError):
        return None
    return beat
