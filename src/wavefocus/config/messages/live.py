"""Orders to ``wavefocus live`` and its events, one JSON object per line."""

from collections.abc import Mapping
from typing import Any, Literal

from wavefocus.config.messages import EventMessage, Message, Number, OrderMessage, Refused

PointMm = tuple[float, float]


class MoveSource(OrderMessage, frozen=True, tag="move"):
    """A position of a source as it is now; a name that does not sound yet begins to sound.

    amplitude: As of a scene's source; None: as before, 1 at first.
    """

    name: str
    at_mm: PointMm
    amplitude: float | None = None


class SetSignal(OrderMessage, frozen=True, tag="signal"):
    """The signal of a source, a table as in a scene file; what sounds with another fades first."""

    name: str
    signal: Mapping[str, Any]
    repeat: bool = True


class EndSource(OrderMessage, frozen=True, tag="end_source"):
    """Let a source fade and vanish."""

    name: str


class EndLive(OrderMessage, frozen=True, tag="end"):
    """Let all sources fade, mute, and end."""


ORDERS = (MoveSource, SetSignal, EndSource, EndLive)


class LiveReady(EventMessage, frozen=True, tag="ready"):
    """It plays, silence at first.

    look_ahead_ms: By how much sources lag what is ordered; sufficient_ms: look-ahead from which nothing is predicted.
    interface_ms: From a sample written to its sound: what waits to be played, and the interface's own latency.
    x_mm, y_mm: From and to, of the measured surface's bounding box.
    osc: Address that takes OSC messages, or an empty text.
    independent: Whether each source is quiet where the others are.
    """

    player: str
    bank: str
    actuators: int
    block_ms: Number
    look_ahead_ms: Number
    sufficient_ms: Number
    interface_ms: Number
    x_mm: PointMm
    y_mm: PointMm
    osc: str = ""
    independent: bool = False


class SoundingSource(Message, frozen=True):
    """A source as its drives begin now; `fading` where its positions are late or it was ended."""

    name: str
    at_mm: PointMm
    amplitude: Number
    fading: bool = False


NoticeCode = Literal[
    "underrun",
    "limited",
    "late",
    "lost",
    "reconnected",
    "recording",
    "bounded",
    "interpolation",
]


class LiveState(EventMessage, frozen=True, tag="state"):
    """Figures of the session, five times a second.

    played_s: Time since it began.
    latency_ms, latency_p999_ms: From a position's arrival to the first drive sample made with it, written: largest
        since the last line; 99.9th percentile of the session.
    load: Time to compute a block over the block's, largest since the last line.
    underruns: Blocks that came too late, in all.
    limited_db: Least gain of the limiter since the last line, 0 where it did nothing.
    """

    played_s: Number
    latency_ms: float | None
    latency_p999_ms: float | None
    load: Number
    underruns: int
    limited_db: Number
    sources: tuple[SoundingSource, ...]


class LiveNotice(EventMessage, frozen=True, tag="notice"):
    """Something that a person should read: a player that ran dry, drives that were limited."""

    code: NoticeCode
    sentence: str


class LiveEnded(EventMessage, frozen=True, tag="ended"):
    """The last line; the outputs are muted.

    recorded: Scene file of the session, or an empty text.
    """

    played_s: Number
    positions: int
    latency_p999_ms: float | None
    underruns: int
    limited_s: Number
    recorded: str = ""

    @property
    def sentence(self) -> str:
        """The same in words."""
        latency = "" if self.latency_p999_ms is None else f", latency {self.latency_p999_ms:.1f} ms (99.9 %)"
        played = f"played {self.played_s:.1f} s, {self.positions} positions{latency}, {self.underruns} underruns"
        return f"{played}{f', recorded in {self.recorded}' if self.recorded else ''}; the outputs are muted"


EVENTS = (LiveReady, LiveState, Refused, LiveNotice, LiveEnded)
