"""The loop of a live session: orders, blocks, the interface; figures and notices as it goes."""

import gc
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress

import numpy as np
from msgspec.structs import replace

from wavefocus.acquisition.engine.recovery import back_off_s
from wavefocus.calibration.numerics import one_blas_thread
from wavefocus.config.messages import Message, Refused
from wavefocus.config.messages.live import (
    EndLive,
    EndSource,
    LiveEnded,
    LiveNotice,
    LiveState,
    MoveSource,
    NoticeCode,
    SoundingSource,
)
from wavefocus.console import one_line
from wavefocus.drivers.errors import InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.timeouts import BoundedPlayer
from wavefocus.live_session.orders import Inbox, Order, UseSignal
from wavefocus.live_session.pace import LatencyHistogram, Pace
from wavefocus.rendering.live.engine import LiveEngine
from wavefocus.rendering.live.limiter import LiveLimiter
from wavefocus.rendering.live.recording import SessionRecording
from wavefocus.storage.errors import InputError

Publish = Callable[[Message], object]

NOTICES_EVERY_S = 2.0
MAX_AHEAD_S = 1.0
TOO_SLOW = "use fewer sources, sources that are not independent, or in Python a longer block_ms"


class LiveSession:
    """Computes block after block and hands them to the player, until it is ended.

    channels: Outputs of the actuators. ahead_s: So much waits to be played.
    adapts: After each underrun twice as much waits, up to a second.
    publish: Receives figures and notices; it must not wait.
    gives_up_s: Longest wait for an interface that is lost.
    duration_s: The session ends by itself after so long; None: it does not.
    gain: Factor on the amplitudes of all orders.
    recording: Receives the courses of all sources; the engine must keep them.
    warning: Published as a notice when it begins.
    """

    def __init__(
        self,
        engine: LiveEngine,
        player: BoundedPlayer,
        limiter: LiveLimiter,
        publish: Publish,
        *,
        channels: tuple[int, ...],
        ahead_s: float,
        adapts: bool = False,
        gives_up_s: float = 0.0,
        duration_s: float | None = None,
        gain: float = 1.0,
        recording: SessionRecording | None = None,
        warning: str = "",
    ) -> None:
        self.engine, self._player, self._limiter, self._publish = engine, player, limiter, publish
        self._channels, self._ahead_s, self._adapts = channels, ahead_s, adapts
        self._gives_up_s, self._duration_s = gives_up_s, duration_s
        self._block_s = engine.block_samples / engine.rate_hz
        self._inbox, self._pace = Inbox(), Pace(self._block_s, ahead_s)
        self._stop, self._ending, self._over = threading.Event(), threading.Event(), False
        self._latency = LatencyHistogram()
        # Since the last state: what each block took, least gain of the limiter.
        self._computed_s: list[float] = []
        self._limited_db = 0.0
        self._underruns, self._limited_s = 0, 0.0
        self._frames = 0
        self._unwritten: deque[tuple[int, float]] = deque()
        self._noticed_s: dict[str, float] = {}
        self._recording, self._record_failed = recording, False
        self._warning = warning
        self._gain, self._amplitudes = gain, dict[str, float]()
        self._late: set[str] = set()
        self._bounded = False

    @property
    def played_s(self) -> float:
        """Scene time of the next block."""
        return self.engine.next_sample / self.engine.rate_hz

    def order(self, order: Order, arrived_s: float, *answers: Future[None]) -> None:
        """Give an order, from any thread; it takes effect with the next block, and then its answers end.

        arrived_s: When it arrived, of `time.monotonic`. Raises InputError: too many orders wait.
        """
        self._inbox.put(order, arrived_s, *answers)
        if isinstance(order, EndLive):
            self._ending.set()

    def stop(self) -> None:
        """End at once, from any thread; the caller of `run` mutes."""
        self._stop.set()
        self._ending.set()

    def run(self, on_begun: Callable[[], object] = lambda: None) -> None:
        """Play until `EndLive`, the end of the duration, or `stop`.

        on_begun: Called when orders take effect at once.

        Raises InstrumentError: The interface failed, or did not come back.
        """
        try:
            with one_blas_thread(), _undisturbed():
                self._begin()
                on_begun()
                if self._warning:
                    self._notice("interpolation", self._warning, always=True)
                while not self._stop.is_set():
                    try:
                        try:
                            self._next_block()
                        except TransientInstrumentError as dry:
                            self._begin_anew(dry)
                    except InstrumentLostError as lost:
                        self._bring_back(lost)
                    if self._over and not self.engine.state():
                        self._play_out()
                        return
        finally:
            self._record()

    def ended(self) -> LiveEnded:
        """The session's last message."""
        recorded = None if self._recording is None else self._recording.scene
        return LiveEnded(
            round(self.played_s, 3), self._inbox.positions, self._latency.percentile_ms(99.9), self._underruns,
            round(self._limited_s, 3), str(recorded or ""),
        )  # fmt: skip

    @property
    def unrecorded(self) -> bool:
        """Whether the record, now closed, holds nothing because no source has sounded long enough."""
        return self._recording is not None and not (self._recording.scene or self._recording.failure)

    def _begin(self) -> None:
        self._player.begin_pieces(self._channels, self._limiter.rate_hz, self._ahead_s)

    def _next_block(self) -> None:
        begun_s = time.monotonic()
        arrived_s = [] if self._pace.short and self.engine.foreseen else self._apply_orders()
        first = self._frames + self._limiter.look_ahead_frames
        frames = self._limiter.limit(self.engine.next_block())
        self._computed_s.append(time.monotonic() - begun_s)
        self._unwritten.extend((first, one_s) for one_s in arrived_s)
        waiting_s = self._player.add_piece(frames)
        self._frames += frames.shape[1]
        while self._unwritten and self._unwritten[0][0] < self._frames:
            self._latency.add(self._player.written_s - self._unwritten.popleft()[1])
        self._account()
        now_s = time.monotonic()
        time.sleep(max(0.0, self._pace.begin_s(now_s, waiting_s) - now_s))

    def _apply_orders(self) -> list[float]:
        """Apply what waits; returns when the positions among it arrived."""
        arrived_s: list[float] = []
        for waiting in self._inbox.take():
            if self._over and isinstance(waiting.order, MoveSource):  # it would begin to sound anew
                waiting.end(InputError("the live session is over"))
                continue
            try:
                self._apply(waiting.order)
            except InputError as wrong:
                waiting.end(wrong)
                if not waiting.answers:
                    self._publish(Refused(one_line(str(wrong), 300)))
                continue
            waiting.end()
            self._over |= isinstance(waiting.order, EndLive)
            if isinstance(waiting.order, MoveSource):
                arrived_s.append(waiting.arrived_s)
        if self._duration_s is not None and self.played_s >= self._duration_s and not self._ending.is_set():
            self._ending.set()
            self._apply(EndLive())
            self._over = True
        return arrived_s

    def _apply(self, order: Order) -> None:
        match order:
            case MoveSource(name, at_mm, amplitude):
                amplitude = self._amplitudes.get(name, 1.0) if amplitude is None else amplitude
                self.engine.move(name, at_mm, self._gain * amplitude)
                self._amplitudes[name] = amplitude
                self._late.discard(name)
            case UseSignal(name, emitted):
                self.engine.set_signal(name, emitted)
            case EndSource(name):
                self.engine.end_source(name)
                self._amplitudes.pop(name, None)
            case EndLive():
                for source in self.engine.state():
                    with suppress(InputError):  # it fades already
                        self._apply(EndSource(source.name))

    def _account(self) -> None:
        """Figures, notices, and five times a second the state."""
        if self._limiter.gain_db < 0:
            self._limited_s += self._block_s
            self._limited_db = min(self._limited_db, self._limiter.gain_db)
            self._notice(
                "limited", f"limited by {-self._limited_db:.1f} dB to stay within the limits: lower the amplitudes"
            )
        for name in self.engine.late_sources():
            if name not in self._late:
                self._late.add(name)
                self._notice("late", f"source {name}: its positions stopped coming; it fades")
        if self.engine.energy_bounded and not self._bounded:
            self._notice(
                "bounded",
                "sources are too near to one another to be as quiet as asked for: that would take more than ten times"
                " the energy",
            )
        self._bounded = self.engine.energy_bounded
        # Five times a second.
        if len(self._computed_s) >= 0.2 / self._block_s:
            self._report(self.engine.state())

    def _report(self, sources: tuple[SoundingSource, ...]) -> None:
        names = {source.name for source in sources}
        self._late &= names
        self._amplitudes = {name: one for name, one in self._amplitudes.items() if name in names}
        self._publish(
            LiveState(
                round(self.played_s, 3),
                self._latency.take_largest_ms(),
                self._latency.percentile_ms(99.9),
                round(max(self._computed_s, default=0.0) / self._block_s, 3),
                self._underruns,
                round(self._limited_db, 2),
                tuple(replace(one, amplitude=one.amplitude / self._gain) for one in sources),
            )
        )
        self._computed_s.clear()
        self._limited_db = 0.0
        self._record()

    def _record(self) -> None:
        if self._recording is None or self._record_failed:
            return
        self._recording.add(self.engine.take_record())
        if self._recording.failure:
            self._record_failed = True
            self._notice("recording", f"nothing more is recorded: {self._recording.failure}", always=True)

    def _begin_anew(self, dry: TransientInstrumentError) -> None:
        """After the player ran dry: silence, then what comes next; the block that came too late is lost."""
        self._underruns += 1
        more = ""
        if grows := self._adapts and self._ahead_s < MAX_AHEAD_S:
            self._ahead_s = min(2 * self._ahead_s, MAX_AHEAD_S)
            more = f"; from now on {1e3 * self._ahead_s:.0f} ms wait to be played"
        others_s = sorted(self._computed_s)[:-1]  # one stand-still of the machine is not slow computing
        if sum(others_s) > len(others_s) * self._block_s:
            took_ms, block_ms = 1e3 * sum(others_s) / len(others_s), 1e3 * self._block_s
            more += f"; computing a block of {block_ms:.3g} ms takes {took_ms:.3g} ms: {TOO_SLOW}"
        self._pace = Pace(self._block_s, self._ahead_s)
        self._unwritten.clear()
        self._notice("underrun", f"{dry.instrument}: {dry.cause}{more}", always=grows)
        self._player.mute()
        self._begin()

    def _bring_back(self, lost: InstrumentLostError) -> None:
        """Wait for an interface that is gone, all sources ended. Raises InstrumentError: it does not come back."""
        self._notice("lost", f"{lost.instrument}: {lost.cause}; it is waited for", always=True)
        self._unwritten.clear()
        gives_up_s, tries = time.monotonic() + self._gives_up_s, 0
        while not self._ending.wait(min(back_off_s(tries), max(0.0, gives_up_s - time.monotonic()))):
            tries += 1
            try:
                self._player.reconnect()
                self._apply_orders()
                self._apply(EndLive())
                self._begin()
            except (InstrumentLostError, TransientInstrumentError):  # it may go again at once
                if time.monotonic() >= gives_up_s:
                    raise lost from None
                continue
            self._notice("reconnected", f"{lost.instrument} is connected again", always=True)
            return
        raise lost

    def _play_out(self) -> None:
        """Let what is still in the conversion, the limiter and the player sound."""
        silence = np.zeros((len(self._channels), round(self._block_s * self._limiter.rate_hz)))
        last = self._frames + self._limiter.look_ahead_frames
        try:
            while self._frames < last:
                frames = self._limiter.limit(silence)
                self._player.add_piece(frames)
                self._frames += frames.shape[1]
            self._player.end_pieces()
            # Beyond what waits to be played and the interface's latency, the last sound has left after so long.
            self._player.wait(self._ahead_s + self._player.latency_s + 5.0)
        except TransientInstrumentError:  # the last of a fade is lost
            self._underruns += 1

    def _notice(self, code: NoticeCode, sentence: str, *, always: bool = False) -> None:
        """Publish a notice, one of a kind in 2 s unless it is to be published always."""
        now_s = time.monotonic()
        if always or now_s - self._noticed_s.get(code, -NOTICES_EVERY_S) >= NOTICES_EVERY_S:
            self._noticed_s[code] = now_s
            self._publish(LiveNotice(code, sentence))


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Other threads of Python give way soon, and what there is already is not searched for garbage meanwhile."""
    interval_s = sys.getswitchinterval()
    gc.collect()
    gc.freeze()
    # Python lets another thread run after so long, in place of 5 ms: reading orders must not hold up a block.
    sys.setswitchinterval(0.0005)
    try:
        yield
    finally:
        sys.setswitchinterval(interval_s)
        gc.unfreeze()
