"""A player over PortAudio: all channels of an audio interface, found by host API and name."""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, TypeVar

import numpy as np

from wavefocus.drivers.audio.resampling import PlayFrames
from wavefocus.drivers.audio.stream import UNDERFLOW, OutputDevice, StreamRequest
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.process import ALIVE, ANSWER_S, ASK, OPENING_S, DriverProcess, ProcessGoneError
from wavefocus.drivers.protocols import DeviceIdentity, Float64Array, Player

Value = TypeVar("Value")

_OVERDUE_S = 5.0
"""A play that has not ended this long after it should have, plus a tenth of its length, has failed."""

_TRIED_AGAIN_AFTER_S = (0.5, 1.5)
"""When a device that is not there yet is opened once more: an interface that was just switched on, one that another
program is about to give up, or a server that lets nobody in for a moment."""

_LOST_REMEDY = "check its power, its cable and its driver or server, then reconnect"


class StreamPlayer(Player):
    """Plays one signal per channel of an audio interface.

    One stream over all channels runs from the moment of opening to that of closing, silent between plays, in a
    process of its own: if it hangs, it is killed. Raises InstrumentError.

    host_api: PortAudio's name of the driver model, such as ``"ASIO"``, ``"Core Audio"`` or ``"JACK Audio Connection
        Kit"``; None for any.
    device: The device's name there, or a part of it that no other has.
    channels: How many outputs to open, from 0; > 0.
    channel_full_scale_v: Volts at full scale of each of them, from calibration; > 0.
    interface_rate_hz: Rate of the stream in Hz.
    block_frames: Frames per callback; 0 for what suits the host.
    environment: Added to the environment of the stream's process, such as ``JACK_DEFAULT_SERVER``.
    """

    def __init__(
        self,
        host_api: str | None,
        device: str,
        *,
        channels: int,
        channel_full_scale_v: Sequence[float],
        interface_rate_hz: int,
        block_frames: int = 0,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._name = f"player {device}"
        self._full_scale_v = tuple(float(volts) for volts in channel_full_scale_v)
        if channels < 1 or len(self._full_scale_v) != channels or not all(0 < v < np.inf for v in self._full_scale_v):
            cause = (
                f"{channels} channels with {len(self._full_scale_v)} full-scale voltages from"
                f" {min(self._full_scale_v, default=math.nan):g} V up"
            )
            remedy = "give one finite voltage above 0 for each channel"
            raise InstrumentError(self._name, "opening", cause, remedy)
        self._request = StreamRequest(host_api, device, channels, interface_rate_hz, block_frames)
        self._environment = dict(environment or {})
        self._frames = PlayFrames(self._name, self._full_scale_v, interface_rate_hz)
        self._ordering = threading.Lock()
        self._closed = False
        self._plays = 0
        self._written_s = -math.inf
        self._open_at_first()
        # Loaded now: records are short, and the first play must not come after its own.
        import_module("scipy.signal")

    @property
    def identity(self) -> DeviceIdentity:
        """Name of the device as PortAudio lists it, without maker or serial number."""
        return self._device.identity

    @property
    def channels(self) -> int:
        return len(self._full_scale_v)

    @property
    def full_scale_v(self) -> float:
        """Largest output magnitude in volts: the smallest full scale of all channels."""
        return min(self._full_scale_v)

    @property
    def latency_s(self) -> float:
        """How long after its callback a sample leaves the outputs, as the host reports."""
        return self._latency_s

    @property
    def written_s(self) -> float:
        return self._written_s

    @property
    def process_id(self) -> int:
        """The process that owns the stream."""
        return self._stream.process.pid

    def identify(self) -> str:
        """Name, host API, channels, rate and latency of the device."""
        self._check_open("identifying")
        stream, asked_s = self._stream, time.monotonic()
        self._send("identifying", ASK)
        self._wait_for("identifying", lambda: stream.alive_s >= asked_s or None, asked_s + 2 * ANSWER_S)
        device = self._device
        rate = f"{self._request.rate_hz} Hz{_measured(self._request.rate_hz, stream.rate_hz)}"
        return (
            f"player {device.name}, {device.host_api}, {self.channels} of {device.channels} channels at {rate},"
            f" latency {1e3 * self.latency_s:.0f} ms, full scale {self.full_scale_v:g} V, {self._library}"
        )

    def play(self, signals_v: Mapping[int, Float64Array], sample_rate_hz: float) -> None:
        """Start playing with the next period; volts by channel, all of one length, none beyond full scale.

        Signals are converted to the interface's rate the first time they are played. Sample 0 stays sample 0:
        what the conversion's low-pass adds before it, down to half a step of a 24-bit converter, is played before
        it, on all channels alike.
        """
        doing = _playing(signals_v)
        self._check_open(doing)
        with self._ordering:
            self._check_silent(doing)
            frames = self._frames.frames(doing, signals_v, sample_rate_hz)
            self._begin(_Play(doing, len(frames) / self._request.rate_hz), tuple(signals_v), len(frames) + 1)
            self._send(doing, ("piece", frames), ("end",))

    def begin_pieces(self, channels: Sequence[int], sample_rate_hz: float, ahead_s: float) -> None:
        doing = f"playing piece by piece on {len(channels)} channels"
        self._check_open(doing)
        with self._ordering:
            rate_hz = self._request.rate_hz
            if sample_rate_hz != rate_hz:
                cause, remedy = f"pieces at {sample_rate_hz:g} Hz", f"give them at the interface's rate, {rate_hz} Hz"
                raise InstrumentError(self._name, doing, cause, remedy)
            if not channels or len(set(channels)) < len(channels) or not set(channels) <= set(range(self.channels)):
                remedy = f"choose each at most once from 0 to {self.channels - 1}"
                raise InstrumentError(self._name, doing, f"channels {list(channels)}", remedy)
            self._check_silent(doing)
            full_scale_v = np.array([self._full_scale_v[channel] for channel in channels])[:, np.newaxis]
            ahead_frames = max(1, round(ahead_s * rate_hz))
            self._begin(_Play(doing, 0.0, full_scale_v, ahead_frames), tuple(channels), ahead_frames)

    def _begin(self, play: _Play, channels: tuple[int, ...], ahead_frames: int) -> None:
        self._plays += 1
        play.number, self._stream.play = self._plays, play
        self._send(play.doing, ("begin", play.number, channels, ahead_frames))

    def add_piece(self, volts: Float64Array) -> float:
        (play, full_scale_v), rate_hz = self._begun(), self._request.rate_hz
        if volts.ndim != 2 or len(volts) != len(full_scale_v) or not (np.abs(volts) <= full_scale_v).all():
            cause = f"a piece of shape {volts.shape} that reaches {np.abs(volts).max(initial=0.0):g} V"
            remedy = f"give one row for each of {len(full_scale_v)} channels, finite and within full scale"
            raise InstrumentError(self._name, play.doing, cause, remedy)
        frames = np.ascontiguousarray((volts / full_scale_v).T, dtype=np.float32)
        before_s = play.waiting_frames / rate_hz
        play.sent_frames += len(frames)
        self._send(play.doing, ("piece", frames))
        self._written_s = time.monotonic()

        def there_is_room() -> bool | None:
            return True if play.outcome or play.waiting_frames <= play.ahead_frames else None

        longest_s = 1.1 * (play.ahead_frames + len(frames)) / rate_hz + 2 * self.latency_s + _OVERDUE_S
        room = self._wait_for(play.doing, there_is_room, time.monotonic() + longest_s)
        if play.outcome == UNDERFLOW:
            raise self._ran_dry(play)
        if room is None:
            raise self._killed(play.doing, "it plays more slowly than its clock says")
        return before_s

    def end_pieces(self) -> None:
        play, _ = self._begun()
        play.length_s = play.waiting_frames / self._request.rate_hz
        play.asked_s = time.monotonic()
        self._send(play.doing, ("end",))

    def wait(self, timeout_s: float) -> None:
        """Return when the last sample has left the outputs, at the latest after `timeout_s`."""
        self._check_open("waiting for the end of the signal")
        play = self._stream.play
        if play is None:
            return
        now_s = time.monotonic()
        overdue_s = play.asked_s + 1.1 * play.length_s + 2 * self.latency_s + _OVERDUE_S
        ended = self._wait_for(play.doing, lambda: play.outcome, min(now_s + timeout_s, max(now_s, overdue_s)))
        if ended == UNDERFLOW:
            raise self._ran_dry(play)
        if ended is None and time.monotonic() >= overdue_s:
            cause = f"it took over {overdue_s - play.asked_s:.1f} s for {play.length_s:.1f} s of sound"
            raise self._killed(play.doing, cause)
        if ended is None:
            raise TransientInstrumentError(
                self._name, play.doing, f"not finished after {timeout_s:g} s", "allow the length of the signal"
            )

    def mute(self) -> None:
        """Silence every channel with the next period, over a fade of 2 ms; from any state, and it never fails.

        Where the stream does not obey, its process is killed, which silences it too; the next call then says so.
        """
        process, play = self._stream.process, self._stream.play
        if self._closed or play is None or play.outcome is not None:
            return
        try:
            process.send("fade")
            if process.wait_for(lambda: play.outcome, time.monotonic() + ANSWER_S) is None:
                process.kill(f"it did not fall silent within {ANSWER_S:g} s of a mute and was killed")
        except ProcessGoneError:
            return

    def reconnect(self) -> None:
        """End the stream's process and open the same device in a new one."""
        self._check_open("reconnecting")
        with self._ordering:
            self._stream.process.close()
            self._open("reconnecting", InstrumentLostError)

    def close(self) -> None:
        """Fade out, release the device and end its process; twice does no harm."""
        if not self._closed:
            self._closed = True
            self._stream.process.close()

    def _open_at_first(self) -> None:
        for wait_s in _TRIED_AGAIN_AFTER_S:
            with suppress(_NotThereYetError):
                return self._open("opening", _NotThereYetError)
            time.sleep(wait_s)
        return self._open("opening", InstrumentError)

    def _open(self, doing: str, refusal: type[InstrumentError]) -> None:
        """Open the device in a fresh process. Raises InstrumentError, of the kind `refusal` where it may pass."""
        self._stream = stream = _Stream(self._environment)
        try:
            stream.process.send(self._request)
            answer = stream.process.wait_for(lambda: stream.answer, time.monotonic() + OPENING_S, asks=False)
            if answer is None:
                stream.process.kill("opening took too long")
                cause = f"its driver did not open it in {OPENING_S:g} s"
                raise InstrumentLostError(self._name, doing, cause, _LOST_REMEDY)
            if answer[0] == "refused":
                _, cause, remedy, absent = answer
                raise (refusal if absent else InstrumentError)(self._name, doing, cause, remedy)
            self._device: OutputDevice = answer[1]
            self._latency_s: float = answer[2]
            self._library: str = answer[3]
        except BaseException as failure:
            stream.process.close()
            if isinstance(failure, ProcessGoneError):
                raise refusal(self._name, doing, str(failure), _LOST_REMEDY) from None
            raise

    def _send(self, doing: str, *messages: object) -> None:
        try:
            self._stream.process.send(*messages)
        except ProcessGoneError as gone:
            raise self._lost(doing, str(gone)) from None

    def _wait_for(self, doing: str, look: Callable[[], Value | None], until_s: float) -> Value | None:
        """See `DriverProcess.wait_for`. Raises InstrumentLostError."""
        try:
            return self._stream.process.wait_for(look, until_s)
        except ProcessGoneError as gone:
            raise self._lost(doing, str(gone)) from None

    def _killed(self, doing: str, cause: str) -> InstrumentLostError:
        """End the process, with what it plays."""
        self._stream.process.kill(cause)
        return self._lost(doing, self._stream.process.gone)

    def _lost(self, doing: str, cause: str) -> InstrumentLostError:
        remedy = "connect again" if self._stream.process.at_rest else _LOST_REMEDY
        return InstrumentLostError(self._name, doing, cause, remedy)

    def _ran_dry(self, play: _Play) -> TransientInstrumentError:
        cause, remedy = f"underflow: {play.notice}", "play from a disk that reads faster, with fewer other programs"
        if play.full_scale_v is not None:
            remedy += ", leave out more (--tolerance-db), close other programs"
        else:
            cause += "; what was recorded meanwhile is void"
            remedy = "repeat it; if it comes again, raise player.block_frames and close other programs"
        return TransientInstrumentError(self._name, play.doing, cause, remedy)

    def _begun(self) -> tuple[_Play, Float64Array]:
        doing, play = "playing piece by piece", self._stream.play
        self._check_open(doing)
        if play is None or play.full_scale_v is None:
            raise InstrumentError(self._name, doing, "none was begun", "begin one first")
        return play, play.full_scale_v

    def _check_silent(self, doing: str) -> None:
        stream = self._stream
        if stream.play is not None and stream.play.outcome is None and not stream.process.gone:
            raise InstrumentError(self._name, doing, "it is still playing", "wait for its end or mute it first")

    def _check_open(self, doing: str) -> None:
        if self._closed:
            raise InstrumentError(self._name, doing, "it is closed", "open the rig again")


class _NotThereYetError(InstrumentError):
    """A device that cannot be opened now, and may be in a moment."""


@dataclass
class _Play:
    """The play under way: its length, and how it ended once the stream's process has reported it.

    full_scale_v, (channels, 1): Of a play that comes in pieces, `ahead_frames` beforehand; None of another.
    """

    doing: str
    length_s: float
    full_scale_v: Float64Array | None = None
    ahead_frames: int = 0
    number: int = 0
    sent_frames: int = 0
    taken_frames: int = 0
    outcome: str | None = None
    notice: str = ""
    asked_s: float = field(default_factory=time.monotonic)

    @property
    def waiting_frames(self) -> int:
        return self.sent_frames - self.taken_frames


class _Stream:
    """The stream's process and what it has reported."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self.answer: tuple[Any, ...] | None = None
        self.play: _Play | None = None
        self.alive_s = -math.inf
        self.rate_hz = math.nan
        self.process = DriverProcess(
            "wavefocus.drivers.audio.stream.player_process",
            "the process that owns its stream",
            self._note,
            # PortAudio would start an audio server of its own where there is none.
            {"JACK_NO_START_SERVER": os.environ.get("JACK_NO_START_SERVER", "1"), **environment},
        )

    def _note(self, message: Any) -> None:
        play = self.play
        match message:
            case ("opened" | "refused", *_):
                self.answer = message
            case ("clocked", rate_hz):
                self.rate_hz = rate_hz
            case ("ended", number, outcome, notice) if play is not None and number == play.number:
                play.notice, play.outcome = notice, outcome
            case ("taken", number, frames) if play is not None and number == play.number:
                play.taken_frames = frames
            case _ if message == ALIVE:
                self.alive_s = time.monotonic()


def _measured(asked_hz: int, measured_hz: float) -> str:
    """The rate at which the interface asks for samples, where it is another one."""
    # Callbacks that differ by this share from the rate that was asked for are those of another rate.
    if math.isnan(measured_hz) or abs(measured_hz / asked_hz - 1) < 0.01:
        return ""
    return f" (it asks for {measured_hz:.0f} a second: set its own panel and player.interface_rate_hz to one rate)"


def _playing(signals_v: Mapping[int, Float64Array]) -> str:
    return f"playing on channels {sorted(signals_v)}" if len(signals_v) < 4 else f"playing on {len(signals_v)} channels"
