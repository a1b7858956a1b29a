"""A player with a latency and a clock of its own."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from wavefocus.drivers.errors import TransientInstrumentError
from wavefocus.drivers.protocols import Float64Array, Player, RecordLabel
from wavefocus.mocks.virtual import NANOSECONDS, VirtualClock, label_share
from wavefocus.mocks.virtual.faults import VirtualDevice
from wavefocus.mocks.virtual.settings import VirtualSettings
from wavefocus.mocks.virtual.synthesis import PlayedSignal, SignalStore, VirtualPlay


@dataclass(slots=True)
class _Pieces:
    """A play that comes in pieces; it sounds when `ahead_s` of it is there; at most that waits."""

    rows: int
    play: VirtualPlay
    ahead_s: float


class VirtualPlayer(VirtualDevice, Player):
    """Plays one signal per channel."""

    def __init__(self, settings: VirtualSettings, clock: VirtualClock) -> None:
        limits = f"{settings.player_channels} channels, full scale {settings.full_scale_v:g} V, 16 bit"
        super().__init__("player", settings.fault_plan, limits)
        self._settings = settings
        self._clock = clock
        self._store = SignalStore(settings.full_scale_v)
        self._plays: deque[VirtualPlay] = deque(maxlen=8)
        self._pieces: _Pieces | None = None
        self._written_s = -math.inf
        self._lock = threading.RLock()
        self._label_under_way: Callable[[], RecordLabel | None] = lambda: None

    @property
    def channels(self) -> int:
        return self._settings.player_channels

    @property
    def full_scale_v(self) -> float:
        return self._settings.full_scale_v

    def play(self, signals_v: Mapping[int, Float64Array], sample_rate_hz: float) -> None:
        doing = f"playing on channels {sorted(signals_v)}" if len(signals_v) < 4 else "playing"
        self._check_open(doing)
        signals = {channel: self._checked(doing, channel, volts) for channel, volts in signals_v.items()}
        lengths = {volts.size for volts in signals_v.values()}
        if len(lengths) != 1 or 0 in lengths:
            raise self._refusal(doing, f"signals of {sorted(lengths)} samples", "give signals of one length, not empty")
        if not sample_rate_hz > 0:
            raise self._refusal(doing, f"rate of {sample_rate_hz} Hz", "choose a rate above 0 Hz")
        with self._lock:
            now_ns = self._clock.now_ns()
            if self._plays and self._end_ns(self._plays[-1]) > now_ns:
                raise self._refusal(doing, "it is still playing", "wait for its end or mute it first")
            label = self._label_under_way()
            self._faults.meet("play", doing, label)
            play = VirtualPlay(now_ns, float(sample_rate_hz), signals, lengths.pop())
            play.latency_s = None if label is None else self._latency_s(label)
            self._plays.append(play)

    @property
    def written_s(self) -> float:
        return self._written_s

    @property
    def latency_s(self) -> float:
        """The longest that it may take from a play's request to its sound."""
        return self._settings.latency_s[1]

    def begin_pieces(self, channels: Sequence[int], sample_rate_hz: float, ahead_s: float) -> None:
        """Begin a play that comes in pieces: it takes its time on the clock, and is not recorded."""
        doing = f"playing piece by piece on {len(channels)} channels"
        self._check_open(doing)
        unknown = [channel for channel in channels if not 0 <= channel < self.channels]
        if unknown or not channels:
            cause = f"there is no channel {unknown[0]}" if unknown else "no channels"
            raise self._refusal(doing, cause, f"choose 0 to {self.channels - 1}")
        with self._lock:
            now_ns = self._clock.now_ns()
            if self._plays and self._end_ns(self._plays[-1]) > now_ns:
                raise self._refusal(doing, "it is still playing", "wait for its end or mute it first")
            self._faults.meet("play", doing, self._label_under_way())
            self._pieces = _Pieces(len(channels), VirtualPlay(now_ns, float(sample_rate_hz), {}, 0), ahead_s)

    def add_piece(self, volts: Float64Array) -> float:
        """Let the time pass until there is room for more; returns how much was waiting before, in seconds.

        On a clock that is the wall's, a piece that comes when all before it has been played comes too late.
        """
        pieces = self._begun()
        reaches_v = float(np.abs(volts).max(initial=0.0))
        if volts.ndim != 2 or len(volts) != pieces.rows or not reaches_v <= self.full_scale_v:
            cause = f"a piece of shape {volts.shape} that reaches {reaches_v:g} V"
            remedy = f"give {pieces.rows} rows within ±{self.full_scale_v:g} V"
            raise self._refusal("playing piece by piece", cause, remedy)
        play, now_ns = pieces.play, self._clock.now_ns()
        if play.duration_s < pieces.ahead_s:
            play.requested_ns = now_ns  # it does not sound yet
        before_s = play.duration_s - max(0, now_ns - play.requested_ns) / NANOSECONDS
        if before_s < 0:
            self._pieces = None
            cause = f"underflow: the next piece came {-1e3 * before_s:.1f} ms late"
            remedy = "have more of it ready beforehand, leave out more, close other programs"
            raise TransientInstrumentError(self._name, "playing piece by piece", cause, remedy)
        play.samples += volts.shape[1]
        self._written_s = time.monotonic()
        self._clock.advance_to_ns(play.requested_ns + round((play.duration_s - pieces.ahead_s) * NANOSECONDS))
        return before_s

    def end_pieces(self) -> None:
        pieces, self._pieces = self._begun(), None
        with self._lock:
            if pieces.play.samples:
                self._plays.append(pieces.play)

    def wait(self, timeout_s: float) -> None:
        self._check_open("waiting for the end of the signal")
        with self._lock:
            now_ns = self._clock.now_ns()
            end_ns = self._end_ns(self._plays[-1]) if self._plays else now_ns
        try:
            self._faults.meet("wait", "playing", self._label_under_way())
        except TransientInstrumentError:
            self._cut((now_ns + end_ns) // 2)  # it ran dry half-way
            raise
        latest_ns = now_ns + round(timeout_s * NANOSECONDS)
        self._clock.advance_to_ns(min(max(end_ns, now_ns), latest_ns))
        if end_ns > latest_ns:
            raise TransientInstrumentError(
                self._name, "playing", f"not finished after {timeout_s:g} s", "allow the length of the signal"
            )

    def mute(self) -> None:
        self._pieces = None
        self._cut(self._clock.now_ns())
        self._faults.meet("mute", "muting")

    def reconnect(self) -> None:
        """Open the device afresh, muted."""
        self._cut(self._clock.now_ns())
        super().reconnect()

    def close(self) -> None:
        if not self._closed:
            self._cut(self._clock.now_ns())
        super().close()

    def follow(self, label_under_way: Callable[[], RecordLabel | None]) -> None:
        """Let latencies be drawn for the label that this function names.

        label_under_way: Gives the label of the record under way, None if there is none.
        """
        self._label_under_way = label_under_way

    def settle_latency(self, label: RecordLabel) -> None:
        """Draw the latency of a play that began before its record, for that record's label."""
        with self._lock:
            if self._plays and self._plays[-1].latency_s is None:
                self._plays[-1].latency_s = self._latency_s(label)

    def plays_between(self, start_ns: int, stop_ns: int) -> list[VirtualPlay]:
        """What sounded between two instants.

        What rings on from a play that had ended is left out: a record would depend on the one before,
        and a resumed campaign would not be the same to the byte.
        """
        with self._lock:
            return [
                play
                for play in self._plays
                if play.samples > 0 and play.requested_ns < stop_ns and self._end_ns(play) > start_ns
            ]

    def _latency_s(self, label: RecordLabel) -> float:
        low_s, high_s = self._settings.latency_s
        return low_s + (high_s - low_s) * label_share(self._settings.seed, label)

    def _end_ns(self, play: VirtualPlay) -> int:
        return play.requested_ns + round((self._longest_latency_s(play) + play.duration_s) * NANOSECONDS)

    def _longest_latency_s(self, play: VirtualPlay) -> float:
        return self._settings.latency_s[1] if play.latency_s is None else play.latency_s

    def _cut(self, instant_ns: int) -> None:
        with self._lock:
            if self._plays and self._end_ns(self._plays[-1]) > instant_ns:
                play = self._plays[-1]
                sounding_s = (instant_ns - play.requested_ns) / NANOSECONDS - self._longest_latency_s(play)
                play.samples = min(play.samples, max(0, int(sounding_s * play.sample_rate_hz)))
                if play.samples == 0:
                    self._plays.pop()

    def _checked(self, doing: str, channel: int, volts: Float64Array) -> PlayedSignal:
        if not 0 <= channel < self.channels:
            raise self._refusal(doing, f"there is no channel {channel}", f"choose 0 to {self.channels - 1}")
        signal = self._store.find(volts) if volts.ndim == 1 else None
        if signal is None or not signal.peak_v <= self.full_scale_v:
            reaches = f" and reaches {signal.peak_v:g} V" if signal is not None else ""
            cause = f"the signal of channel {channel} has the shape {volts.shape}{reaches}"
            raise self._refusal(doing, cause, f"give finite voltages within ±{self.full_scale_v:g} V, one row")
        return signal

    def _begun(self) -> _Pieces:
        self._check_open("playing piece by piece")
        if self._pieces is None:
            raise self._refusal("playing piece by piece", "none was begun", "begin one first")
        return self._pieces
