"""PortAudio's outputs by host API and name, the stream over one of them, and what its callback plays."""

import queue
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wavefocus.drivers.protocols import DeviceIdentity, Float32Array, uncounted

FADE_S = 0.002
"""Length of the fade of a mute, within one period, so that the coils do not click."""

_SLOWEST = 5e-4
"""How much slower than its nominal rate a sound clock may run; crystals keep to a fifth of this."""

_PERIODS_AFTER = 2
"""Periods after the last sample before a play has ended well: an underflow is flagged a period late."""

PLAYED, MUTED, UNDERFLOW = "played", "muted", "underflow"


class StreamPlay:
    """Frames that are handed over in pieces by one thread, while the stream's puts them into periods.

    frames: Length of it all; unbounded until the end is announced.
    channels: Outputs, in the order of the pieces' columns.
    reserve_frames: Fewer than these left before the end is announced: it has run dry, with enough left to fade out
        over.
    report: Receives "taken", its number, and how many frames have been put into periods, after each piece.
    """

    def __init__(
        self, number: int, channels: Sequence[int], reserve_frames: int, report: Callable[[tuple[Any, ...]], None]
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
        self._pieces: deque[Float32Array] = deque()
        self._taken = 0

    def add(self, piece: Float32Array) -> None:
        """Hand over the next frames, (frames, channels), parts of full scale."""
        self._pieces.append(piece)
        self.received += len(piece)

    def end(self) -> None:
        """Say that no more comes."""
        self.frames = self.received

    @property
    def is_whole(self) -> bool:
        """Whether its end was announced."""
        return self.frames < sys.maxsize

    def put(self, out: Float32Array) -> str:
        """Put the next frames into a silent period; returns what is missing, or an empty text."""
        dry = not self.is_whole and self.received - self._taken < len(out) + self._reserve_frames
        place = 0
        while place < len(out) and self._pieces:
            piece = self._pieces[0]
            count = min(len(out) - place, len(piece))
            out[place : place + count, self._channels] = piece[:count]
            self._taken += count
            place += count
            if count < len(piece):
                self._pieces[0] = piece[count:]
            else:
                self._pieces.popleft()
                self._report(("taken", self.number, self._taken))
        return "the next piece of the signal did not come in time" if dry else ""


class Playback:
    """Fills the periods of one stream; plays and mutes are handed over between periods.

    latency_s: How long after its callback a period leaves the outputs, as the stream reports.

    events: Of each play, in order: "ended", its number, `PLAYED`, `MUTED` or `UNDERFLOW`, and what was noticed; before
        it what `StreamPlay` reports.
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
        self.events: queue.SimpleQueue[tuple[Any, ...]] = queue.SimpleQueue()
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
        self._grid_s += len(out) / self._rate_hz * (1 + _SLOWEST)
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
            if play.periods_after >= _PERIODS_AFTER and play.done >= play.frames + self._latency_frames:
                self._end(PLAYED)
        play.done += frames

    def _see_out(self, play: StreamPlay, frames: int) -> None:
        """End a play that was cut short once its last sound has left the outputs: a record may begin then."""
        assert play.ending is not None
        play.silent_frames += frames
        play.periods_after += self._burst_frames == frames
        if play.periods_after >= _PERIODS_AFTER and play.silent_frames >= self._latency_frames:
            self._end(*play.ending)

    def _end(self, outcome: str, notice: str = "") -> None:
        if self._play is not None:
            self.events.put(("ended", self._play.number, outcome, notice))
            self._play = None


def _fade(out: Float32Array, frames: int) -> None:
    """Half a cosine down to silence from the period's start."""
    frames = min(frames, len(out))
    ramp = 0.5 + 0.5 * np.cos(np.pi * (np.arange(frames, dtype=np.float32) + 1) / frames)
    out[:frames] *= ramp[:, np.newaxis]
    out[frames:] = 0


@dataclass(frozen=True, slots=True)
class OutputDevice:
    """An output as PortAudio lists it.

    index: PortAudio's own, good for one process only.
    host_api, name: Which driver model offers it (``"ASIO"``, ``"Core Audio"``, ``"JACK Audio Connection Kit"``) and its
        name there.
    channels: Largest number of output channels.
    rate_hz: The rate it is set to or prefers, in Hz.
    """

    index: int
    host_api: str
    name: str
    channels: int
    rate_hz: float

    @property
    def identity(self) -> DeviceIdentity:
        """Its name; PortAudio reports neither maker nor serial number.

        With ALSA the name ends in the card's number, " (hw:2,0)", which depends on what was plugged in first. On
        Windows it may contain a number, "(2- X)", that depends on the socket.
        """
        name = self.name.partition(" (hw:")[0] if self.host_api == "ALSA" else uncounted(self.name)
        return DeviceIdentity("", name)

    def __str__(self) -> str:
        return f"{self.name!r} ({self.host_api}, {self.channels} channels, {self.rate_hz:g} Hz)"


class DeviceChoiceError(Exception):
    """There is no device that is and does what was asked for, or more than one.

    cause, remedy: See `wavefocus.drivers.errors.InstrumentError`.
    absent: Whether it may yet come, so that trying again can help.
    """

    def __init__(self, cause: str, remedy: str, *, absent: bool = False) -> None:
        super().__init__(f"{cause}; {remedy}")
        self.cause = cause
        self.remedy = remedy
        self.absent = absent


def choose(devices: Sequence[OutputDevice], host_apis: Sequence[str], host_api: str | None, name: str) -> OutputDevice:
    """The one device that is meant. Raises DeviceChoiceError.

    devices: What there is.
    host_apis: What PortAudio was built with and finds at work.
    host_api: Name of a host API, in either case; None for any.
    name: The device's name, or a part of it that no other has.
    """
    apis = ", ".join(repr(api) for api in host_apis) or "none"
    if host_api is not None and host_api.casefold() not in (api.casefold() for api in host_apis):
        raise DeviceChoiceError(
            f"there is no host API {host_api!r}; there are {apis}",
            "start its server or install its driver, or correct player.host_api",
            absent=True,
        )
    within = [device for device in devices if host_api is None or device.host_api.casefold() == host_api.casefold()]
    exact = [device for device in within if device.name.casefold() == name.casefold()]
    plain = uncounted(name).casefold()
    found = (
        exact
        or [device for device in within if name.casefold() in device.name.casefold()]
        or [device for device in within if plain in uncounted(device.name).casefold()]
    )
    if len(found) == 1:
        return found[0]
    if found:
        remedy = "set player.host_api and player.device to what only one of them has"
        if len({(device.host_api, device.name) for device in found}) < len(found):
            remedy += "; where both have one name, unplug one or rename it in the system's sound settings"
        raise DeviceChoiceError(f"{len(found)} outputs are called that: {_listed(found)}", remedy)
    offered = f"host API {host_api!r} has" if host_api is not None else f"the host APIs {apis} have"
    raise DeviceChoiceError(
        f"there is no output of that name; {offered} {_listed(within)}",
        "plug it in and switch it on, or correct player.device",
        absent=True,
    )


def _listed(devices: Sequence[OutputDevice]) -> str:
    return ", ".join(str(device) for device in devices) or "no outputs"


# PortAudio's error numbers, portaudio.h
_INVALID_CHANNEL_COUNT = -9998
_INVALID_SAMPLE_RATE = -9997
_DEVICE_UNAVAILABLE = -9985

_TICK_S = 0.05
"""How often a stream is looked at."""

_SILENT_LIMIT_S = 0.5
_SILENT_LIMIT_PERIODS = 5
"""A callback that is overdue by the larger of these is not coming: the driver is frozen."""


@dataclass(frozen=True, slots=True)
class StreamRequest:
    """What to open; `host_api` and `device`: see `choose`, `block_frames` 0 for the host's."""

    host_api: str | None
    device: str
    channels: int
    rate_hz: int
    block_frames: int


def _outputs(sounddevice: Any) -> tuple[tuple[OutputDevice, ...], tuple[str, ...]]:
    """All outputs there are, and the names of all host APIs, in PortAudio's order."""
    host_apis = tuple(str(api["name"]) for api in sounddevice.query_hostapis())
    devices = tuple(
        OutputDevice(
            int(listed["index"]),
            host_apis[int(listed["hostapi"])],
            str(listed["name"]),
            int(listed["max_output_channels"]),
            float(listed["default_samplerate"]),
        )
        for listed in sounddevice.query_devices()
        if listed["max_output_channels"] > 0
    )
    return devices, host_apis


class WatchedStream:
    """An output stream that runs from now on, silent until something is played. Raises DeviceChoiceError.

    latency_s: How long after its callback a period leaves the outputs, as the host reports.
    """

    def __init__(self, sounddevice: Any, request: StreamRequest) -> None:
        self._sounddevice = sounddevice
        self.rate_hz = request.rate_hz
        self.device = choose(*_outputs(sounddevice), request.host_api, request.device)
        if self.device.channels < request.channels:
            raise DeviceChoiceError(
                f"the rig needs {request.channels} channels, {self.device} has fewer",
                "correct player.channels and player.loopback_channel, or choose another device or host API"
                " (on Windows, ASIO)",
            )
        self._used = request.channels
        settings = {"device": self.device.index, "dtype": "float32", "samplerate": request.rate_hz}
        if self.device.host_api == "Core Audio":
            # macOS would resample behind our back rather than say that the interface runs at another rate.
            settings["extra_settings"] = sounddevice.CoreAudioSettings(
                change_device_parameters=True, fail_if_conversion_required=True
            )
        self._period_s = 0.0
        # Some interfaces open only with all their channels.
        for channels in sorted({request.channels, self.device.channels}):
            try:
                self._start(settings | {"channels": channels}, request.block_frames)
            except sounddevice.PortAudioError as error:
                if channels == self.device.channels or _code(error) != _INVALID_CHANNEL_COUNT:
                    raise _refused(self.device, request, error) from error
            else:
                break

    def _start(self, settings: dict[str, Any], block_frames: int) -> None:
        """Open the stream and let it run. Raises sounddevice.PortAudioError."""
        self._sounddevice.check_output_settings(**settings)
        self._stream = self._sounddevice.OutputStream(
            **settings, blocksize=block_frames, latency="high", dither_off=True, callback=self._callback
        )
        told_s = float(self._stream.latency)
        # More than 5 s is no latency: PortAudio reports 2**32 - 1 frames for a JACK client that has not set its own.
        self.latency_s = told_s if 0 <= told_s <= 5.0 else 0.0
        self.playback = Playback(self.rate_hz, self.latency_s)
        self._stream.start()

    def watch(self, stopping: Callable[[], bool]) -> str:
        """Look at the stream until it is lost.

        stopping: Looked at each time; True ends the watch.

        Returns str: what happened to the stream; empty if the watch was ended.
        """
        seen, silent_s, looked_s = -1, 0.0, time.monotonic()
        while not stopping():
            time.sleep(_TICK_S)
            now_s = time.monotonic()
            # A watch that was itself kept waiting by a busy machine must not blame the driver.
            silent_s += min(now_s - looked_s, 2 * _TICK_S)
            looked_s = now_s
            if self.playback.callbacks != seen:
                seen, silent_s = self.playback.callbacks, 0.0
            if not self._stream.active:
                return "it stopped and the host closed its stream: unplugged, switched off, or its server ended"
            if silent_s > max(_SILENT_LIMIT_S, _SILENT_LIMIT_PERIODS * self._period_s):
                return f"its driver is frozen: it asked for nothing more for {silent_s:.1f} s"
        return ""

    def silence(self) -> None:
        """Mute, and return when the fade has been put into a period."""
        self.playback.mute()
        enough = self.playback.callbacks + 2
        latest_s = time.monotonic() + max(_SILENT_LIMIT_S, _SILENT_LIMIT_PERIODS * self._period_s)
        while self.playback.callbacks < enough and time.monotonic() < latest_s:
            time.sleep(self._period_s / 4 + 1e-3)

    def close(self) -> None:
        """Silence it, then stop and release it; with a host that is gone this never returns."""
        self.silence()
        self._stream.abort()
        self._stream.close()
        # The package would do so at exit; an audio server is glad to see its clients leave in good order.
        self._sounddevice._terminate()

    def _callback(self, out: Any, frames: int, _time: Any, status: Any) -> None:
        now_s = time.monotonic()
        self._period_s = frames / self.rate_hz
        out[:, self._used :] = 0
        self.playback.fill(out[:, : self._used], now_s, flagged=bool(status.output_underflow))


def _code(error: Exception) -> Any:
    """PortAudio's number of an error."""
    return error.args[1] if len(error.args) > 1 else None


def _refused(device: OutputDevice, request: StreamRequest, error: Exception) -> DeviceChoiceError:
    """PortAudio's refusal as a sentence."""
    code = _code(error)
    if code == _INVALID_SAMPLE_RATE:
        cause = f"{device} does not run at {request.rate_hz} Hz"
        remedy = "set the interface to that rate in its own panel, or player.interface_rate_hz to the interface's"
    elif code == _INVALID_CHANNEL_COUNT:
        cause = f"{device} does not open with {request.channels} channels"
        remedy = "choose another host API (on Windows, ASIO)"
    elif code == _DEVICE_UNAVAILABLE:
        cause, remedy = f"{device} is not to be had", "close other programs that use it, plug it in again"
    else:
        cause, remedy = f"PortAudio cannot open {device}: {error.args[0]}", "power the interface off and on again"
    return DeviceChoiceError(cause, remedy, absent=code not in (_INVALID_SAMPLE_RATE, _INVALID_CHANNEL_COUNT))
