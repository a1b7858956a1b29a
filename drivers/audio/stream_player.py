"""A player over PortAudio: all channels of an audio interface, found by host API and name."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.audio.playback import UNDERFLOW
from drivers.audio.portaudio import OutputDevice
from drivers.audio.signals import Order, PlayOrders
from drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from drivers.process import ANSWER_S, OPENING_S, DriverProcess, Message, ProcessGoneError
from drivers.protocols import DeviceIdentity

LOST_REMEDY = "check its power, its cable and its driver or server, then reconnect"


def lost(name: str, doing: str, gone: ProcessGoneError) -> InstrumentLostError:
    """What to say of a player whose stream's process is gone."""
    return InstrumentLostError(name, doing, gone.cause, LOST_REMEDY)


class PlayUnderWay:
    """What is known of a play here; the stream's process tells how it ended."""

    def __init__(self, number: int, doing: str, length_s: float, asked_s: float) -> None:
        self.number = number
        self.doing = doing
        self.length_s = length_s
        self.asked_s = asked_s
        self.outcome: str | None = None
        self.notice = ""
        self.handed_frames = 0
        """Of a play that comes in pieces: how many frames the stream's process was given."""
        self.taken_frames = 0
        """And how many of them it has played."""


class StreamLife:
    """One life of the stream's process, and what it told."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self.opened: Message = {}
        self.play: PlayUnderWay | None = None
        self._heard_s = 0.0
        self.process = DriverProcess(
            "drivers.audio.player_process",
            "the process that owns its stream",
            environment,
            self._note,
            # PortAudio would start an audio server of its own where there is none.
            {"JACK_NO_START_SERVER": "1"},
        )

    def heard_after(self, instant_s: float) -> bool | None:
        """True when a sign of life came after an instant."""
        return True if self._heard_s > instant_s else None

    def _note(self, message: Message, payload: bytes) -> None:
        if message["is"] in ("open", "failed"):
            self.opened = message
        elif message["is"] == "here":
            self._heard_s = time.monotonic()
        elif message["is"] == "ended" and self.play is not None and message["number"] == self.play.number:
            self.play.notice = message["notice"]
            self.play.outcome = message["outcome"]
        elif message["is"] == "taken" and self.play is not None and message["number"] == self.play.number:
            self.play.taken_frames = message["frames"]


Float64Array = NDArray[np.float64]

LATE_S = 5.0
"""Beyond the length of what waits to be played, and a tenth of it: then the stream does not go on."""


class PiecewisePlay:
    """Checks pieces, hands them over, and waits for room.

    Parameters
    ----------
    name : str
        The player's, for messages.
    stream : StreamLife
        Where it plays.
    channels : sequence of int
        Outputs, in the order of the pieces' rows; each once.
    full_scale_v : sequence of float
        Of each of them.
    rate_hz : int
        The interface's.
    ahead_s : float
        How much may wait; it sounds when so much is there, or all.
    """

    def __init__(
        self,
        name: str,
        stream: StreamLife,
        channels: Sequence[int],
        full_scale_v: Sequence[float],
        rate_hz: int,
        ahead_s: float,
    ) -> None:
        self._name = name
        self._stream = stream
        self._channels = list(channels)
        self._full_scale_v = np.array(full_scale_v)[:, np.newaxis]
        self._rate_hz = rate_hz
        self._ahead_frames = max(1, round(ahead_s * rate_hz))
        self._play = PlayUnderWay(0, "", 0.0, time.monotonic())

    def begin(self, number: int) -> None:
        """Announce it."""
        doing = f"playing piece by piece on {len(self._channels)} channels"
        self._play = self._stream.play = PlayUnderWay(number, doing, 0.0, time.monotonic())
        self._send({"do": "begin", "number": number, "channels": self._channels, "ahead": self._ahead_frames})

    def add(self, volts: Float64Array, latency_s: float) -> float:
        """Hand over the next samples and wait for room; tells how much was still to be played before, in seconds."""
        play = self._play
        if volts.ndim != 2 or len(volts) != len(self._channels) or not (np.abs(volts) <= self._full_scale_v).all():
            raise InstrumentError(
                self._name,
                play.doing,
                f"a piece of shape {volts.shape} that reaches {np.abs(volts).max(initial=0.0):g} V",
                f"give one row for each of {len(self._channels)} channels, finite and within full scale",
            )
        frames = np.ascontiguousarray((volts / self._full_scale_v).T, dtype=np.float32)
        before_s = (play.handed_frames - play.taken_frames) / self._rate_hz
        play.handed_frames += len(frames)
        self._send({"do": "piece"}, frames.data.cast("B"))

        def there_is_room() -> bool | None:
            return True if play.outcome or play.handed_frames - play.taken_frames <= self._ahead_frames else None

        longest_s = 1.1 * (self._ahead_frames + len(frames)) / self._rate_hz + 2 * latency_s + LATE_S
        try:
            room = self._stream.process.wait_for(there_is_room, time.monotonic() + longest_s)
        except ProcessGoneError as gone:
            raise lost(self._name, play.doing, gone) from None
        if play.outcome == UNDERFLOW:
            raise self.ran_dry()
        if room is None:
            self._stream.process.kill("it plays more slowly than its clock says")
            raise lost(self._name, play.doing, ProcessGoneError(self._stream.process.gone))
        return before_s

    def end(self) -> None:
        """Say that no more comes."""
        play = self._play
        play.length_s = (play.handed_frames - play.taken_frames) / self._rate_hz
        play.asked_s = time.monotonic()
        self._send({"do": "end"})

    def ran_dry(self) -> TransientInstrumentError:
        """What to say of it when the pieces came too late."""
        return TransientInstrumentError(
            self._name,
            self._play.doing,
            f"underflow: {self._play.notice}",
            "have more of it ready beforehand (--ahead-s), leave out more (--tolerance-db), close other programs",
        )

    def _send(self, message: dict[str, object], payload: bytes | memoryview = b"") -> None:
        try:
            self._stream.process.send((message, payload))
        except ProcessGoneError as gone:
            raise lost(self._name, self._play.doing, gone) from None


Float32Array = NDArray[np.float32]

OVERDUE_S = 5.0
"""A play that has not ended so long after it should have, and a tenth of its length, is not going to."""


class StreamPlayer:
    """Plays one signal per channel of an audio interface; implements `drivers.protocols.Player`.

    One stream over all channels runs from the moment of opening to that of closing, silent between plays, in a
    process of its own: what hangs there is killed, and nobody waits for it.

    Parameters
    ----------
    host_api : str or None
        PortAudio's name of the driver model, such as ``"ASIO"``, ``"Core Audio"`` or
        ``"JACK Audio Connection Kit"``; None for any.
    device : str
        The device's name there, or a part of it that no other has.
    channels : int
        How many outputs to open, from 0; > 0.
    channel_full_scale_v : sequence of float
        Volts at full scale of each of them, from calibration; > 0.
    interface_rate_hz : int
        Rate of the stream in Hz.
    block_frames : int
        Frames per callback; 0 for what suits the host.
    environment : mapping from str to str, optional
        Added to the environment of the stream's process, such as ``JACK_DEFAULT_SERVER``.

    Raises
    ------
    InstrumentError
        No such device, or it does not do what is asked, or PortAudio is missing.
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
            raise InstrumentError(
                self._name,
                "opening",
                f"{channels} channels with {len(self._full_scale_v)} full-scale voltages from"
                f" {min(self._full_scale_v, default=math.nan):g} V up",
                "give one finite voltage above 0 for each channel",
            )
        self._request: Message = {
            "host_api": host_api,
            "device": device,
            "channels": channels,
            "rate_hz": interface_rate_hz,
            "block_frames": block_frames,
        }
        self._environment = dict(environment or {})
        self._orders = PlayOrders(self._name, self._full_scale_v, interface_rate_hz)
        self._ordering = threading.Lock()
        self._closed = False
        self._plays = 0
        self._pieces: PiecewisePlay | None = None
        self._stream = StreamLife(self._environment)
        try:
            self._open("opening", InstrumentError)
        except BaseException:
            self._end_stream()
            raise

    @property
    def identity(self) -> DeviceIdentity:
        """Name of the device as PortAudio lists it, which knows neither maker nor serial number."""
        return self._identity

    @property
    def channels(self) -> int:
        """Number of output channels that are open."""
        return len(self._full_scale_v)

    @property
    def full_scale_v(self) -> float:
        """Largest output magnitude in volts: the smallest full scale of all channels."""
        return self._orders.full_scale_v

    @property
    def latency_s(self) -> float:
        """How long after its callback a sample leaves the outputs, as the host tells."""
        return float(self._stream.opened["latency_s"])

    @property
    def process_id(self) -> int:
        """The process that owns the stream."""
        return self._stream.process.pid

    @property
    def signals_converted(self) -> int:
        """How many signals were converted to the interface's rate so far; a repeated one is not."""
        return self._orders.signals_converted

    def identify(self) -> str:
        """Name, host API, channels, rate and latency of the device."""
        self._check_open("identifying")
        stream = self._stream
        asked_s = time.monotonic()
        try:
            stream.process.send(({"do": "ask"}, b""))
            stream.process.wait_for(lambda: stream.heard_after(asked_s), asked_s + 2 * ANSWER_S)
        except ProcessGoneError as gone:
            raise lost(self._name, "identifying", gone) from None
        device = OutputDevice(**stream.opened["device"])
        return (
            f"player {device.name}, {device.host_api}, {self.channels} of {device.channels} channels at"
            f" {self._request['rate_hz']} Hz, latency {1e3 * self.latency_s:.0f} ms,"
            f" full scale {self.full_scale_v:g} V, {stream.opened['library']}"
        )

    def prepare(self, signals_v: Mapping[int, Float64Array], sample_rate_hz: float) -> None:
        """Convert signals that will be played, so that their first play starts as soon as any other.

        Parameters
        ----------
        signals_v, sample_rate_hz
            As of `play`, and refused for the same reasons.
        """
        doing = _playing(signals_v)
        self._check_open(doing)
        with self._ordering:
            self._send(doing, self._orders.order(doing, signals_v, sample_rate_hz).before)

    def play(self, signals_v: Mapping[int, Float64Array], sample_rate_hz: float) -> None:
        """Start playing with the next period; volts by channel, all of one length, none beyond full scale.

        Signals are converted to the interface's rate the first time they are played. Sample 0 stays sample 0:
        what the conversion's low-pass adds before it, down to half a step of a 24-bit converter, is played before
        it, on all channels alike.
        """
        doing = _playing(signals_v)
        self._check_open(doing)
        with self._ordering:
            stream = self._stream
            self._check_silent(doing)
            order = self._orders.order(doing, signals_v, sample_rate_hz)
            self._plays += 1
            stream.play = PlayUnderWay(self._plays, doing, order.frames / self._request["rate_hz"], time.monotonic())
            start = ({"do": "play", "number": self._plays, "voices": order.voices}, b"")
            self._send(doing, [*order.before, start])

    def begin_pieces(self, channels: Sequence[int], sample_rate_hz: float, ahead_s: float) -> None:
        """Begin a play that comes in pieces at the interface's rate; it sounds when `ahead_s` of it is there, or all.

        Parameters
        ----------
        channels, sample_rate_hz, ahead_s
            As of `drivers.protocols.PiecewisePlayer.begin_pieces`.
        """
        doing = f"playing piece by piece on {len(channels)} channels"
        self._check_open(doing)
        with self._ordering:
            rate_hz = self._request["rate_hz"]
            if sample_rate_hz != rate_hz:
                cause, remedy = f"pieces at {sample_rate_hz:g} Hz", f"give them at the interface's rate, {rate_hz} Hz"
                raise InstrumentError(self._name, doing, cause, remedy)
            if not channels or len(set(channels)) < len(channels) or not set(channels) <= set(range(self.channels)):
                remedy = f"choose each at most once from 0 to {self.channels - 1}"
                raise InstrumentError(self._name, doing, f"channels {list(channels)}", remedy)
            self._check_silent(doing)
            self._plays += 1
            each_v = [self._full_scale_v[channel] for channel in channels]
            self._pieces = PiecewisePlay(self._name, self._stream, channels, each_v, rate_hz, ahead_s)
            self._pieces.begin(self._plays)

    def add_piece(self, volts: Float64Array) -> float:
        """Hand over the next samples and wait until no more than `ahead_s` of them are not played yet.

        Parameters
        ----------
        volts : float64 array, shape (channels, samples)
            As of `drivers.protocols.PiecewisePlayer.add_piece`.

        Returns
        -------
        float
            How much was still to be played before, in seconds.
        """
        return self._begun().add(volts, self.latency_s)

    def end_pieces(self) -> None:
        """Say that no more comes; `wait` returns when all of it was played."""
        self._begun().end()

    def wait(self, timeout_s: float) -> None:
        """Return when the last sample has left the outputs, at the latest after `timeout_s`."""
        doing = "waiting for the end of the signal"
        self._check_open(doing)
        stream = self._stream
        play = stream.play
        if play is None:
            return
        now_s = time.monotonic()
        overdue_s = play.asked_s + 1.1 * play.length_s + 2 * self.latency_s + OVERDUE_S
        try:
            ended = stream.process.wait_for(lambda: play.outcome, min(now_s + timeout_s, max(now_s, overdue_s)))
        except ProcessGoneError as gone:
            raise lost(self._name, play.doing, gone) from None
        if ended == UNDERFLOW:
            if self._pieces is not None:
                raise self._pieces.ran_dry()
            raise TransientInstrumentError(
                self._name,
                play.doing,
                f"underflow: {play.notice}; what was recorded meanwhile is void",
                "repeat it; if it comes again, raise player.block_frames and close other programs",
            )
        if ended is None and time.monotonic() >= overdue_s:
            stream.process.kill(f"it took over {overdue_s - play.asked_s:.1f} s for {play.length_s:.1f} s of sound")
            raise lost(self._name, play.doing, ProcessGoneError(stream.process.gone))
        if ended is None:
            raise TransientInstrumentError(
                self._name, play.doing, f"not finished after {timeout_s:g} s", "allow the length of the signal"
            )

    def mute(self) -> None:
        """Silence every channel with the next period, over a fade of 2 ms; from any state, and it never fails.

        Where the stream does not obey, its process is killed, which silences it too; the next call then says so.
        """
        stream = self._stream
        play = stream.play
        if self._closed or play is None or play.outcome is not None:
            return
        try:
            stream.process.send(({"do": "mute"}, b""))
            if stream.process.wait_for(lambda: play.outcome, time.monotonic() + ANSWER_S) is None:
                stream.process.kill(f"it did not fall silent within {ANSWER_S:g} s of a mute and was killed")
        except ProcessGoneError:
            return

    def reconnect(self) -> None:
        """End the stream's process and open the same device in a new one."""
        doing = "reconnecting"
        self._check_open(doing)
        with self._ordering:
            self._end_stream()
            self._orders.forget()
            self._pieces = None
            self._stream = StreamLife(self._environment)
            try:
                self._open(doing, InstrumentLostError)
            except BaseException:
                self._end_stream()
                raise

    def close(self) -> None:
        """Fade out, release the device and end its process; twice does no harm."""
        if not self._closed:
            self._closed = True
            self._end_stream()

    def _open(self, doing: str, refusal: type[InstrumentError]) -> None:
        stream = self._stream
        try:
            stream.process.send((self._request, b""))
            answer = stream.process.wait_for(lambda: stream.opened or None, time.monotonic() + OPENING_S)
        except ProcessGoneError as gone:
            raise refusal(self._name, doing, gone.cause, LOST_REMEDY) from None
        if answer is None:
            stream.process.kill("opening took too long")
            raise InstrumentLostError(self._name, doing, f"its driver did not open it in {OPENING_S:g} s", LOST_REMEDY)
        if answer["is"] == "failed":
            kind = refusal if answer["absent"] else InstrumentError
            raise kind(self._name, doing, answer["cause"], answer["remedy"])
        self._identity = OutputDevice(**answer["device"]).identity

    def _end_stream(self) -> None:
        process = self._stream.process
        if not process.gone:
            try:
                process.send(({"do": "close"}, b""))
            except ProcessGoneError:
                process.kill("it is gone")
        process.close()

    def _send(self, doing: str, messages: Sequence[Order]) -> None:
        try:
            self._stream.process.send(*messages)
        except ProcessGoneError as gone:
            raise lost(self._name, doing, gone) from None

    def _begun(self) -> PiecewisePlay:
        doing = "playing piece by piece"
        self._check_open(doing)
        if self._pieces is None:
            raise InstrumentError(self._name, doing, "none was begun", "begin one first")
        return self._pieces

    def _check_silent(self, doing: str) -> None:
        stream = self._stream
        if stream.play is not None and stream.play.outcome is None and not stream.process.gone:
            raise InstrumentError(self._name, doing, "it is still playing", "wait for its end or mute it first")
        self._pieces = None

    def _check_open(self, doing: str) -> None:
        if self._closed:
            raise InstrumentError(self._name, doing, "it is closed", "open the rig again")


def _playing(signals_v: Mapping[int, Float64Array]) -> str:
    return f"playing on channels {sorted(signals_v)}" if len(signals_v) < 4 else f"playing on {len(signals_v)} channels"
