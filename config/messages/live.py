"""Orders to ``wavefocus live`` and its events, one JSON object per line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from wavefocus.config.messages.codec import Message

PointMm = tuple[float, float]


@dataclass(frozen=True)
class MoveSource(Message, order="move"):
    """A position of a source as it is now; a name that does not sound yet begins to sound.

    amplitude: As of a scene's source; None: as before, 1 at first.
    """

    sparse = True
    name: str
    at_mm: PointMm
    amplitude: float | None = None


@dataclass(frozen=True)
class SetSignal(Message, order="signal"):
    """The signal of a source, a table as in a scene file; what sounds with another fades first."""

    name: str
    signal: Mapping[str, object]
    repeat: bool = True


@dataclass(frozen=True)
class EndSource(Message, order="end_source"):
    """Let a source fade and vanish."""

    name: str


@dataclass(frozen=True)
class EndLive(Message, order="end"):
    """Let all sources fade, mute, and end."""


ORDERS = (MoveSource, SetSignal, EndSource, EndLive)


@dataclass(frozen=True)
class LiveReady(Message, event="ready"):
    """It plays, silence at first.

    look_ahead_ms: By how much sources lag what is ordered; sufficient_ms: look-ahead from which nothing is predicted.
    interface_ms: From a sample written to its sound: what waits to be played, and the interface's own latency.
    x_mm, y_mm: From and to, of the measured surface's bounding box.
    osc: Address that takes OSC messages, or an empty text.
    """

    player: str
    bank: str
    actuators: int
    block_ms: float
    look_ahead_ms: float
    sufficient_ms: float
    interface_ms: float
    x_mm: PointMm
    y_mm: PointMm
    osc: str = ""


@dataclass(frozen=True)
class SoundingSource:
    """A source as it sounds now; `fading` where its positions are late or it was ended."""

    name: str
    at_mm: PointMm
    amplitude: float
    fading: bool = False


Degradation = Literal["none", "bins", "sources"]
NoticeCode = Literal["degraded", "recovered", "underrun", "limited", "late", "lost", "reconnected", "recording"]


@dataclass(frozen=True)
class LiveState(Message, event="state"):
    """Figures of the session, five times a second.

    played_s: Time since it began.
    latency_ms, latency_p999_ms: From a position's arrival to the first drive sample made with it, written: largest
        since the last line; 99.9th percentile of the session.
    load: Time to compute a block over the block's, largest since the last line.
    underruns: Blocks that came too late, in all.
    degradation: What is left out to keep pace; `bound_db`: bound on the relative error from it, None where nothing is;
        `dropped`: names of sources that are left out.
    limited_db: Least gain of the limiter since the last line, 0 where it did nothing.
    """

    played_s: float
    latency_ms: float | None
    latency_p999_ms: float | None
    load: float
    underruns: int
    degradation: Degradation
    bound_db: float | None
    dropped: tuple[str, ...]
    limited_db: float
    sources: tuple[SoundingSource, ...]


@dataclass(frozen=True)
class LiveRefused(Message, event="refused"):
    """An order was wrong: what, and what is allowed."""

    sentence: str


@dataclass(frozen=True)
class LiveNotice(Message, event="notice"):
    """Something that a person should read: degraded, recovered, ran dry, limited."""

    code: NoticeCode
    sentence: str


@dataclass(frozen=True)
class LiveEnded(Message, event="ended"):
    """The last line; the outputs are muted.

    recorded: Scene file of the session, or an empty text.
    """

    played_s: float
    positions: int
    latency_p999_ms: float | None
    underruns: int
    limited_s: float
    recorded: str = ""


EVENTS = (LiveReady, LiveState, LiveRefused, LiveNotice, LiveEnded)
