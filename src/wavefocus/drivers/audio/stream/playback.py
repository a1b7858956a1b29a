"""The stream's callback: puts signals into periods, sees them out of the outputs, notices gaps."""

import queue
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from wavefocus.drivers.protocols import Float32Array

FADE_S = 0.002
"""Length of the fade of a mute, within one period, so that the coils do not click."""

SLOWEST = 5e-4
"""How much slower than its nominal rate a sound clock may run; crystals keep to a fifth of this."""

PERIODS_AFTER = 2
"""Periods after the last sample before a play has ended well: an underflow is flagged a period late."""

PLAYED, MUTED, UNDERFLOW = "played", "muted", "underflow"


@dataclass(frozen=True, slots=True)
class Taken:
    """So many frames of a play have been put into periods."""

    number: int
    frames: int


@dataclass(frozen=True, slots=True)
class PlayEnded:
    """How a play ended: `PLAYED`, `MUTED`, or `UNDERFLOW` with what was noticed."""

    number: int
    outcome: str
    notice: str = ""


class StreamPlay:
    """Frames that are handed over in pieces by one thread, while the stream's puts them into periods.

    frames: Length of it all; unbounded until the end is announced.
    channels: Outputs, in the order of the pieces' columns.
    reserve_frames: Fewer than these left before the end is announced: it has run dry, with enough left to fade out
        over.
    report: Receives `Taken` after each piece.
    """

    def __init__(
        self, number: int, channels: Sequence[int], reserve_frames: int, report: Callable[[Taken], None]
    ) -> None:
        self.number = number
        self.frames = sys.maxsize
        self.done = 0
        self.periods_after = 0
        self.silent_frames = 0
        self.ending: tuple[str, str] | None = None
        self.received = 0
        self._channels = list(channels)
        self._reserve_frames = reserve_frames
        self._report = report
        self._pieces: queue.SimpleQueue[Float32Array] = queue.SimpleQueue()
        self._piece = np.zeros((0, len(self._channels)), dtype=np.float32)
        self._taken = 0

    def add(self, piece: Float32Array) -> None:
        """Hand over the next frames, (frames, channels), parts of full scale."""
        self._pieces.put(piece)
        self.received += len(piece)

    def end(self) -> None:
        """Say that no more comes."""
        self.frames = self.received

    def put(self, out: Float32Array) -> str:
        """Put the next frames into a silent period; returns what is missing, or an empty text."""
        ended = self.frames != sys.maxsize
        dry = not ended and self.received - self._taken < len(out) + self._reserve_frames
        place = 0
        while place < len(out):
            if not len(self._piece):
                try:
                    self._piece = self._pieces.get_nowait()
                except queue.Empty:
                    break
            count = min(len(out) - place, len(self._piece))
            out[place : place + count, self._channels] = self._piece[:count]
            self._piece = self._piece[count:]
            self._taken += count
            place += count
            if not len(self._piece):
                self._report(Taken(self.number, self._taken))
        return "the next piece of the signal did not come in time" if dry else ""


class Playback:
    """Fills the periods of one stream; plays and mutes are handed over between periods.

    latency_s: How long after its callback a period leaves the outputs, as the stream reports.

    events: One end for each play, in order; and what was taken of one that comes piece by piece.
    callbacks: How many periods were filled so far.
    """

    def __init__(self, rate_hz: int, latency_s: float) -> None:
        self._rate_hz = rate_hz
        self._latency_frames = max(0, round(latency_s * rate_hz))
        self._orders: queue.SimpleQueue[StreamPlay | None] = queue.SimpleQueue()
        self._play: StreamPlay | None = None
        self._grid_s = -np.inf
        self._called_s = -np.inf
        self._burst_frames = 0
        self._host_frames = 0
        self._first_s = np.inf
        self._frames = self._before = 0
        self.events: queue.SimpleQueue[PlayEnded | Taken] = queue.SimpleQueue()
        self.callbacks = 0

    @property
    def measured_rate_hz(self) -> float:
        """Frames per second that the interface asks for, by the computer's clock; NaN while that is not known yet."""
        seconds = self._called_s - self._first_s
        # After 5 s the rate of the callbacks is known to a part in a thousand or so.
        return self._before / seconds if seconds >= 5.0 else float("nan")

    def start(self, play: StreamPlay) -> None:
        """Let a play begin with the next period."""
        self._orders.put(play)

    def mute(self) -> None:
        """Let the next period fade out."""
        self._orders.put(None)

    def fill(self, out: Float32Array, now_s: float, *, flagged: bool) -> None:
        """Fill one period; called by the stream.

        out, float32 (frames, channels): The period, written in full.
        now_s: Instant of the callback, of a clock that never runs backwards.
        flagged: Whether the stream says that it ran dry since the last callback.
        """
        out.fill(0)
        self._first_s = min(self._first_s, now_s)
        self._before = self._frames
        self._frames += len(out)
        # Some hosts ask for their period in several callbacks at once (PortAudio over JACK: 1024 frames each).
        at_once = now_s - self._called_s < 0.5 * len(out) / self._rate_hz
        self._burst_frames = len(out) + (self._burst_frames if at_once else 0)
        self._host_frames = max(self._host_frames, self._burst_frames)
        self._called_s = now_s
        # Callbacks come on a grid of periods; how far this one is off it, taking the earliest so far for punctual.
        self._grid_s = min(now_s, self._grid_s)
        late_s = now_s - self._grid_s
        fade = False
        while not self._orders.empty():
            order = self._orders.get_nowait()
            if order is None:
                fade = self._play is not None and self._play.done > 0
                if not fade:
                    self._end(MUTED)
            else:
                self._end(*(MUTED, "") if self._play is None or not self._play.ending else self._play.ending)
                self._play, fade = order, False
                late_s, self._grid_s = 0.0, now_s
        if self._play is not None:
            self._go_on(self._play, out, late_s, flagged=flagged, fade=fade)
        self._grid_s += len(out) / self._rate_hz * (1 + SLOWEST)
        self.callbacks += 1

    def _go_on(self, play: StreamPlay, out: Float32Array, late_s: float, *, flagged: bool, fade: bool) -> None:
        frames = len(out)
        if play.ending is not None:
            self._see_out(play, frames)
            return
        missing = play.put(out)
        notice = "the host flagged an underflow" if flagged else missing
        # Not every host flags underflows; a long one shows in the time that went by.
        buffered_s = (self._latency_frames + 2 * self._host_frames) / self._rate_hz
        # Beyond what is buffered, a callback that comes so late has left the outputs without sound.
        if late_s > buffered_s + 0.05 and not notice:
            notice = f"the stream fell {1e3 * late_s:.0f} ms behind"
        if notice or fade:
            _fade(out, round(FADE_S * self._rate_hz))
            play.ending = (UNDERFLOW if notice else MUTED, notice)
            return
        # Time passes between periods, not between the callbacks of one.
        if play.done >= play.frames and self._burst_frames == frames:
            play.periods_after += 1
            if play.periods_after >= PERIODS_AFTER and play.done >= play.frames + self._latency_frames:
                self._end(PLAYED)
        play.done += frames

    def _see_out(self, play: StreamPlay, frames: int) -> None:
        """End a play that was cut short once its last sound has left the outputs: a record may begin then."""
        assert play.ending is not None
        play.silent_frames += frames
        play.periods_after += self._burst_frames == frames
        if play.periods_after >= PERIODS_AFTER and play.silent_frames >= self._latency_frames:
            self._end(*play.ending)

    def _end(self, outcome: str, notice: str = "") -> None:
        if self._play is not None:
            self.events.put(PlayEnded(self._play.number, outcome, notice))
            self._play = None


def _fade(out: Float32Array, frames: int) -> None:
    """Half a cosine down to silence from the period's start."""
    frames = min(frames, len(out))
    ramp = 0.5 + 0.5 * np.cos(np.pi * (np.arange(frames, dtype=np.float32) + 1) / frames)
    out[:frames] *= ramp[:, np.newaxis]
    out[frames:] = 0
