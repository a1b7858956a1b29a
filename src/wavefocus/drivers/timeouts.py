"""The three roles with an end to every call: a driver that hangs counts as an instrument that is lost."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from queue import SimpleQueue
from typing import Any, Generic, Literal, TypeVar

from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.protocols import (
    DeviceIdentity,
    Float64Array,
    Instrument,
    Mirror,
    Player,
    Recorder,
    Recording,
    RecordRequest,
)

Answer = TypeVar("Answer")
Device = TypeVar("Device", bound=Instrument)
_Calls = SimpleQueue[tuple[Future[Any], Callable[[], object]] | None]


class HungError(Exception):
    """A call did not return in its time and was given up."""


class ShutError(InstrumentError):
    """Nothing is played, for the player was shut meanwhile."""


class CallThread:
    """Carries out calls one after another in one thread of this name, each with a time limit.

    A thread whose call hangs is abandoned: it is a daemon, so that it holds up no exit, and the next call gets a fresh
    thread. What an abandoned call returns in the end is dropped.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._calls: _Calls | None = None
        self._under_way: Future[Any] | None = None

    def call(
        self,
        ask: Callable[[], Answer],
        limit_s: float,
        *,
        wait_before_s: float | None = None,
        needs_thread: bool = True,
    ) -> Answer:
        """Carry out one call and wait `limit_s` (> 0, on the wall's clock) for its end; returns and raises what it did.

        Raises HungError if it did not return in time, RuntimeError or MemoryError if no thread can be started.

        wait_before_s: How long a call before this one, whose wait was broken off by a signal, may still take;
            `limit_s`, if absent. With 0 this call overtakes it, which its instrument must be made for.
        needs_thread: If False and no thread can be started, the call is carried out in this one, without a limit: an
            instrument must fall silent.
        """
        before = self._under_way
        if before is not None and not _over(before, limit_s if wait_before_s is None else wait_before_s):
            self.abandon()
        if self._calls is None:
            calls: _Calls = SimpleQueue()
            try:
                threading.Thread(target=_carry_out, args=(calls,), name=self._name, daemon=True).start()
            except (RuntimeError, MemoryError):
                if needs_thread:
                    raise
                return ask()
            self._calls = calls
        # Left set when a signal breaks the wait off: the thread is then still at it.
        call: Future[Answer] = Future()
        self._under_way = call
        self._calls.put((call, ask))
        if not _over(call, limit_s):
            self.abandon()
            raise HungError
        self._under_way = None
        try:
            return call.result()
        finally:
            del call  # the traceback of a failure holds this frame, and this frame the failure

    def abandon(self) -> None:
        """Let the present thread end by itself, now or never."""
        if self._calls is not None:
            self._calls.put(None)
        self._calls = self._under_way = None


def _carry_out(calls: _Calls) -> None:
    while (asked := calls.get()) is not None:
        call, ask = asked
        try:
            call.set_result(ask())
        except BaseException as failure:  # raised again where the answer is waited for
            call.set_exception(failure)
        del asked, call, ask  # what it returned may be large, and the next call may be long in coming


def in_time(instrument: str, operation: str, ask: Callable[[], Answer], limit_s: float) -> Answer:
    """Carry out one call in a thread of its own, for at most `limit_s` (> 0, on the wall's clock).

    Raises InstrumentLostError: it did not come back in that time.
    """
    thread = CallThread(f"{operation} {instrument}")
    try:
        return thread.call(ask, limit_s)
    except HungError:
        raise InstrumentLostError(instrument, operation, _hung_cause(limit_s), _REMEDY) from None
    finally:
        thread.abandon()


def _hung_cause(limit_s: float) -> str:
    """What happened to a call that hangs, in words."""
    return f"the call did not come back within {limit_s:.3g} s"


def _over(call: Future[Any], limit_s: float) -> bool:
    """Whether a call came to its end within `limit_s`."""
    until_s = time.monotonic() + limit_s
    while not call.done():
        left_s = until_s - time.monotonic()
        if left_s <= 0:
            return False
        with suppress(TimeoutError):
            # No lock is woken by a signal on Windows; four times a second Python looks for one there.
            call.exception(min(left_s, 0.25))
    return True


Role = Literal["mirror", "recorder", "player"]

# Opening a device afresh comprises several answers, and some boot.
RECONNECTING = 3.0
_REMEDY = "its driver hangs: switch the instrument off and on or plug it in again, and restart its server if it has one"


class _Bounded(Instrument, Generic[Device]):
    """An instrument with its calls in a thread of its own, so that every call ends.

    A call that takes `hung_after_s` (> 0, longer than any answer that the drivers themselves wait for) longer than the
    operation itself on the wall's clock raises `InstrumentLostError`, with the role noted. Afterwards the instrument
    does nothing but fall silent, park and close, until it has been connected afresh.
    """

    _role: Role

    def __init__(self, device: Device, hung_after_s: float) -> None:
        self._device = device
        self._hung_after_s = hung_after_s
        self._name: str = self._role
        self._thread = CallThread(self._role)
        self._hung = ""

    @property
    def identity(self) -> DeviceIdentity:
        return self._device.identity

    def identify(self) -> str:
        identity = self._work("identifying", self._device.identify)
        self._name = identity.split(",")[0]
        return identity

    def reconnect(self) -> None:
        self._call("reconnecting", self._device.reconnect, RECONNECTING * self._hung_after_s)
        self._hung = ""

    def close(self) -> None:
        try:
            self._call("closing", self._device.close, needs_thread=False)
        finally:
            self._thread.abandon()

    def _work(self, operation: str, ask: Callable[[], Answer], own_s: float = 0.0) -> Answer:
        """Carry out a call that takes `own_s` by itself; none while one before it hangs in the same driver."""
        if self._hung:
            raise self._lost(operation, self._hung)
        return self._call(operation, ask, own_s + self._hung_after_s)

    def _rest(self, operation: str, ask: Callable[[], None]) -> None:
        """Fall silent: it passes a call that was broken off, and needs no thread."""
        self._call(operation, ask, wait_before_s=0.0, needs_thread=False)

    def _call(
        self,
        operation: str,
        ask: Callable[[], Answer],
        limit_s: float | None = None,
        *,
        wait_before_s: float | None = None,
        needs_thread: bool = True,
    ) -> Answer:
        limit_s = self._hung_after_s if limit_s is None else limit_s
        wait_before_s = self._hung_after_s if wait_before_s is None else wait_before_s
        try:
            return self._thread.call(ask, limit_s, wait_before_s=wait_before_s, needs_thread=needs_thread)
        except HungError:
            cause = _hung_cause(limit_s)
            self._hung = f"{operation} hangs: {cause}"
            raise self._lost(operation, cause) from None
        except InstrumentError as failure:
            failure.role = failure.role or self._role
            raise

    def _lost(self, operation: str, cause: str) -> InstrumentLostError:
        lost = InstrumentLostError(self._name, operation, cause, _REMEDY)
        lost.role = self._role
        return lost


class BoundedMirror(_Bounded[Mirror], Mirror):
    """A mirror whose every call ends."""

    _role = "mirror"

    def move_to(self, x_mrad: float, y_mrad: float) -> None:
        doing = f"moving to ({x_mrad:.3f}, {y_mrad:.3f}) mrad"
        self._work(doing, lambda: self._device.move_to(x_mrad, y_mrad))

    def wait_settled(self, timeout_s: float) -> None:
        self._work("settling", lambda: self._device.wait_settled(timeout_s), timeout_s)

    def park(self) -> None:
        self._call("parking", self._device.park, needs_thread=False)

    def block(self) -> None:
        self._rest("closing the shutter", self._device.block)

    def where_mrad(self) -> tuple[float, float] | None:
        return self._work("reading the position", self._device.where_mrad)


class BoundedRecorder(_Bounded[Recorder], Recorder):
    """A recorder whose every call ends."""

    _role = "recorder"
    _recording = "reading"

    @property
    def input_ranges_v(self) -> tuple[float, ...]:
        return self._device.input_ranges_v

    def start(self, request: RecordRequest) -> None:
        self._recording = f"recording {request.label}"
        self._work(f"starting {request.label}", lambda: self._device.start(request))

    def read(self, timeout_s: float) -> Recording:
        return self._work(self._recording, lambda: self._device.read(timeout_s), timeout_s)

    def sampling_delay_s(self, sample_rate_hz: float) -> float | None:
        doing = "asking for its conversion rate"
        return self._work(doing, lambda: self._device.sampling_delay_s(sample_rate_hz))

    def abort(self) -> None:
        self._rest("aborting", self._device.abort)


class BoundedPlayer(_Bounded[Player], Player):
    """A player whose every call ends, and that can be shut for everybody but one."""

    _role = "player"
    _ahead_s = 0.0

    def __init__(self, device: Player, hung_after_s: float) -> None:
        super().__init__(device, hung_after_s)
        self._gate = threading.Lock()
        self._shut = 0

    def shut(self) -> None:
        """Fall silent, and play nothing until `open`; from any thread, whatever call is under way."""
        with self._gate:
            self._shut += 1
        self._device.mute()

    def open(self) -> None:
        """Take one `shut` back; does no harm where there was none."""
        with self._gate:
            self._shut = max(0, self._shut - 1)

    @property
    def channels(self) -> int:
        return self._device.channels

    @property
    def full_scale_v(self) -> float:
        return self._device.full_scale_v

    @property
    def latency_s(self) -> float:
        return self._device.latency_s

    @property
    def written_s(self) -> float:
        return self._device.written_s

    def play(self, signals_v: Mapping[int, Float64Array], sample_rate_hz: float) -> None:
        # Signals may be converted to the interface's rate first, which takes longer the longer they are.
        sounding_s = max((len(signal_v) for signal_v in signals_v.values()), default=0) / max(sample_rate_hz, 1.0)
        self._work("playing", lambda: self._play_unless_shut(signals_v, sample_rate_hz), sounding_s)

    def _play_unless_shut(self, signals_v: Mapping[int, Float64Array], sample_rate_hz: float) -> None:
        if not self._shut:
            self._device.play(signals_v, sample_rate_hz)
            if not self._shut:
                return
            self._device.mute()
        raise ShutError("player", "playing", "it was muted meanwhile", "give the order again")

    def begin_pieces(self, channels: Sequence[int], sample_rate_hz: float, ahead_s: float) -> None:
        self._ahead_s = ahead_s
        doing = "beginning to play piece by piece"
        self._work(doing, lambda: self._device.begin_pieces(channels, sample_rate_hz, ahead_s))

    def add_piece(self, volts: Float64Array) -> float:
        return self._work("playing piece by piece", lambda: self._device.add_piece(volts), 2 * self._ahead_s)

    def end_pieces(self) -> None:
        self._work("ending to play piece by piece", self._device.end_pieces)

    def wait(self, timeout_s: float) -> None:
        self._work("waiting for the end of the signal", lambda: self._device.wait(timeout_s), timeout_s)

    def mute(self) -> None:
        self._rest("muting", self._device.mute)
