"""The three roles with an end to every call: a driver that hangs counts as an instrument that is lost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from queue import SimpleQueue
from typing import Literal, TypeVar

from drivers.errors import InstrumentError, InstrumentLostError
from drivers.protocols import (
    DeviceIdentity,
    Float64Array,
    Instruments,
    Mirror,
    PiecewisePlayer,
    Player,
    Recorder,
    Recording,
    RecordRequest,
)

Answer = TypeVar("Answer")

# No lock is woken by a signal on Windows; this often Python gets to look for one there.
SLICE_S = 0.25


class HungError(Exception):
    """A call did not return in its time and was given up."""


class CallThread:
    """Carries out calls one after another in one thread, each for so long and no longer.

    A thread whose call hangs is abandoned: it is a daemon, so that it holds up no exit, and the next call
    gets a fresh thread. What an abandoned call returns in the end is of no interest to anybody.

    Parameters
    ----------
    name : str
        Of the threads.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._thread: _Thread | None = None
        self._under_way: _Call | None = None

    def call(
        self, ask: Callable[[], Answer], limit_s: float, *, yields_s: float | None = None, anyhow: bool = False
    ) -> Answer:
        """Carry out one call and wait for its end.

        Parameters
        ----------
        ask : callable
            The call.
        limit_s : float
            Longest wait on the wall's clock, > 0.
        yields_s : float, optional
            How long a call before this one, whose wait was broken off by a signal, may still take; `limit_s`, if
            absent. With 0 this call overtakes it, which its instrument must be made for.
        anyhow : bool
            Where no thread can be started, carry the call out in this one, without a limit: to fall silent.

        Returns
        -------
        object
            What the call returned.

        Raises
        ------
        HungError
            It did not return in time.
        RuntimeError
            No thread can be started.
        BaseException
            Whatever it raised.
        """
        before = self._under_way
        if before is not None:
            before.wait(limit_s if yields_s is None else yields_s)
            if not before.over:
                self.abandon()
        if self._thread is None:
            try:
                self._thread = _Thread(self._name)
            except (RuntimeError, MemoryError):
                if not anyhow:
                    raise
                return ask()
        call = self._under_way = _Call(ask)
        self._thread.calls.put(call)
        # Left set when a signal breaks the wait off: the thread is then still at it.
        if not call.wait(limit_s):
            self.abandon()
            raise HungError
        self._under_way = None
        if call.failure is not None:
            try:
                raise call.failure
            finally:
                call.failure = None  # its traceback holds this frame, and this frame the call
        answer: Answer = call.answer  # type: ignore[assignment]
        return answer

    def abandon(self) -> None:
        """Let the present thread end by itself, now or never."""
        if self._thread is not None:
            self._thread.calls.put(None)
        self._thread = self._under_way = None


class _Call:
    def __init__(self, ask: Callable[[], object]) -> None:
        self._ask = ask
        self._waiting = threading.Lock()
        self._waiting.acquire()
        self.answer: object = None
        self.failure: BaseException | None = None
        self.over = False

    def run(self) -> None:
        try:
            self.answer = self._ask()
        except BaseException as failure:  # raised again where the answer is waited for
            self.failure = failure
        self.over = True
        self._waiting.release()

    def wait(self, limit_s: float) -> bool:
        """Whether the call came to its end within `limit_s`."""
        if self._waiting.acquire(timeout=min(max(0.0, limit_s), SLICE_S)):
            return True
        until_s = time.monotonic() + limit_s - SLICE_S
        while (left_s := until_s - time.monotonic()) > 0:
            if self._waiting.acquire(timeout=min(left_s, SLICE_S)):
                return True
        return self.over


class _Thread:
    def __init__(self, name: str) -> None:
        self.calls: SimpleQueue[_Call | None] = SimpleQueue()
        threading.Thread(target=self._run, name=name, daemon=True).start()

    def _run(self) -> None:
        while (call := self.calls.get()) is not None:
            call.run()
            del call  # what it returned may be large, and the next call may be long in coming


Role = Literal["mirror", "recorder", "player"]

# Opening a device afresh comprises several answers, and some boot.
RECONNECTING = 3.0
REMEDY = "its driver hangs: switch the instrument off and on or plug it in again, and restart its server if it has one"


def bounded(instruments: Instruments, hung_after_s: float) -> Instruments:
    """Instruments whose every call ends.

    Parameters
    ----------
    instruments : Instruments
        As their drivers made them.
    hung_after_s : float
        How much longer than the operation itself a call may take on the wall's clock before it counts as
        hung, > 0: longer than any answer that the drivers themselves wait for. Afterwards the instrument does
        nothing but fall silent, park and close, until it has been connected afresh.

    Returns
    -------
    Instruments
        The same three, their calls in threads of their own; a call that does not return in time raises
        `InstrumentLostError`, with the role noted.
    """
    return Instruments(
        mirror=BoundedMirror(instruments.mirror, hung_after_s),
        recorder=BoundedRecorder(instruments.recorder, hung_after_s),
        player=BoundedPlayer(instruments.player, hung_after_s),
        clock=instruments.clock,
    )


class _Calls:
    """Calls to one instrument, each with its limit and in its words."""

    def __init__(self, role: Role, hung_after_s: float) -> None:
        self.name: str = role
        self._role = role
        self._hung_after_s = hung_after_s
        self._lane = CallThread(role)
        self._hung = ""

    def work(self, operation: str, ask: Callable[[], Answer], own_s: float = 0.0) -> Answer:
        """Carry out a call that takes `own_s` by itself; none while one before it hangs in the same driver."""
        if self._hung:
            raise self._lost(operation, self._hung)
        return self.call(operation, ask, own_s)

    def call(
        self,
        operation: str,
        ask: Callable[[], Answer],
        own_s: float = 0.0,
        *,
        patience: float = 1.0,
        overtakes: bool = False,
        anyhow: bool = False,
    ) -> Answer:
        """Carry out a call in any case; `overtakes` passes one that was broken off, `anyhow` is as of `CallThread`."""
        limit_s = own_s + patience * self._hung_after_s
        try:
            return self._lane.call(ask, limit_s, yields_s=0.0 if overtakes else self._hung_after_s, anyhow=anyhow)
        except HungError:
            cause = f"the call did not come back within {limit_s:.3g} s"
            self._hung = f"{operation} hangs: {cause}"
            raise self._lost(operation, cause) from None
        except InstrumentError as failure:
            failure.role = failure.role or self._role
            raise

    def identify(self, ask: Callable[[], str]) -> str:
        identity = self.work("identifying", ask)
        self.name = identity.split(",")[0]
        return identity

    def reconnect(self, ask: Callable[[], None]) -> None:
        self.call("reconnecting", ask, patience=RECONNECTING)
        self._hung = ""

    def close(self, ask: Callable[[], None]) -> None:
        try:
            self.call("closing", ask, anyhow=True)
        finally:
            self._lane.abandon()

    def _lost(self, operation: str, cause: str) -> InstrumentLostError:
        lost = InstrumentLostError(self.name, operation, cause, REMEDY)
        lost.role = self._role
        return lost


class BoundedMirror:
    """A mirror whose every call ends; implements `drivers.protocols.Mirror`.

    Parameters
    ----------
    mirror : Mirror
        The mirror.
    hung_after_s : float
        As of `bounded`.
    """

    def __init__(self, mirror: Mirror, hung_after_s: float) -> None:
        self._mirror = mirror
        self._calls = _Calls("mirror", hung_after_s)

    @property
    def identity(self) -> DeviceIdentity:
        return self._mirror.identity

    def identify(self) -> str:
        return self._calls.identify(self._mirror.identify)

    def move_to(self, x_mrad: float, y_mrad: float) -> None:
        doing = f"moving to ({x_mrad:.3f}, {y_mrad:.3f}) mrad"
        self._calls.work(doing, lambda: self._mirror.move_to(x_mrad, y_mrad))

    def wait_settled(self, timeout_s: float) -> None:
        self._calls.work("settling", lambda: self._mirror.wait_settled(timeout_s), timeout_s)

    def park(self) -> None:
        self._calls.call("parking", self._mirror.park, anyhow=True)

    def reconnect(self) -> None:
        self._calls.reconnect(self._mirror.reconnect)

    def close(self) -> None:
        self._calls.close(self._mirror.close)


class BoundedRecorder:
    """A recorder whose every call ends; implements `drivers.protocols.Recorder`.

    Parameters
    ----------
    recorder : Recorder
        The recorder.
    hung_after_s : float
        As of `bounded`.
    """

    def __init__(self, recorder: Recorder, hung_after_s: float) -> None:
        self._recorder = recorder
        self._calls = _Calls("recorder", hung_after_s)
        self._recording = "reading"

    @property
    def identity(self) -> DeviceIdentity:
        return self._recorder.identity

    def identify(self) -> str:
        return self._calls.identify(self._recorder.identify)

    def start(self, request: RecordRequest) -> None:
        self._recording = f"recording {request.take}"
        self._calls.work(f"starting {request.take}", lambda: self._recorder.start(request))

    def read(self, timeout_s: float) -> Recording:
        return self._calls.work(self._recording, lambda: self._recorder.read(timeout_s), timeout_s)

    def abort(self) -> None:
        self._calls.call("aborting", self._recorder.abort, overtakes=True, anyhow=True)

    def reconnect(self) -> None:
        self._calls.reconnect(self._recorder.reconnect)

    def close(self) -> None:
        self._calls.close(self._recorder.close)


class BoundedPlayer:
    """A player whose every call ends; implements `drivers.protocols.Player`.

    Parameters
    ----------
    player : Player
        The player.
    hung_after_s : float
        As of `bounded`.
    """

    def __init__(self, player: Player, hung_after_s: float) -> None:
        self._player = player
        self._calls = _Calls("player", hung_after_s)
        self._ahead_s = 0.0

    @property
    def channels(self) -> int:
        return self._player.channels

    @property
    def full_scale_v(self) -> float:
        return self._player.full_scale_v

    @property
    def identity(self) -> DeviceIdentity:
        return self._player.identity

    def identify(self) -> str:
        return self._calls.identify(self._player.identify)

    def play(self, signals_v: Mapping[int, Float64Array], sample_rate_hz: float) -> None:
        # Signals may be converted to the interface's rate first, which takes longer the longer they are.
        sounding_s = max((len(one) for one in signals_v.values()), default=0) / max(sample_rate_hz, 1.0)
        self._calls.work("playing", lambda: self._player.play(signals_v, sample_rate_hz), sounding_s)

    @property
    def latency_s(self) -> float:
        return self._piecewise("asking for its latency").latency_s

    def begin_pieces(self, channels: Sequence[int], sample_rate_hz: float, ahead_s: float) -> None:
        doing = "beginning to play piece by piece"
        player, self._ahead_s = self._piecewise(doing), ahead_s
        self._calls.work(doing, lambda: player.begin_pieces(channels, sample_rate_hz, ahead_s))

    def add_piece(self, volts: Float64Array) -> float:
        doing = "playing piece by piece"
        player = self._piecewise(doing)
        return self._calls.work(doing, lambda: player.add_piece(volts), 2 * self._ahead_s)

    def end_pieces(self) -> None:
        doing = "ending to play piece by piece"
        self._calls.work(doing, self._piecewise(doing).end_pieces)

    def wait(self, timeout_s: float) -> None:
        self._calls.work("waiting for the end of the signal", lambda: self._player.wait(timeout_s), timeout_s)

    def mute(self) -> None:
        self._calls.call("muting", self._player.mute, overtakes=True, anyhow=True)

    def reconnect(self) -> None:
        self._calls.reconnect(self._player.reconnect)

    def close(self) -> None:
        self._calls.close(self._player.close)

    def _piecewise(self, doing: str) -> PiecewisePlayer:
        if not isinstance(self._player, PiecewisePlayer):
            cause = "its driver takes no signal in pieces"
            raise InstrumentError(self._calls.name, doing, cause, "render the scene to a drive file and play that")
        return self._player
