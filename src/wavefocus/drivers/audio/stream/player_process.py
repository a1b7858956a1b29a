"""The process that owns the audio stream: it can be killed when a driver hangs, and ends, muted, with its parent."""

import gc
import os
import sys
import threading
import time
import traceback
from dataclasses import dataclass

from wavefocus.drivers.audio.stream.portaudio import (
    FADE_S,
    DeviceChoiceError,
    OutputDevice,
    StreamPlay,
    StreamRequest,
    WatchedStream,
    load_sounddevice,
)
from wavefocus.drivers.process import STOPPED, Alive, Ask, Close, Lost, MessagePipe, pipe_to_parent, wait_for_silence
from wavefocus.drivers.protocols import Float32Array

CLOSING_S = 3.0
"""Closing a stream whose host is gone hangs, and JACK takes a period for each channel; then the process just ends."""


@dataclass(frozen=True, slots=True)
class Opened:
    """The stream runs: its device, its latency in s, and PortAudio's version."""

    device: OutputDevice
    latency_s: float
    library: str


@dataclass(frozen=True, slots=True)
class Clocked:
    """Rate of the callbacks by the computer's clock in Hz; NaN while it is not known yet."""

    rate_hz: float


@dataclass(frozen=True, slots=True)
class OpeningRefused:
    """The stream cannot be opened; `absent`: see `DeviceChoiceError`."""

    cause: str
    remedy: str
    absent: bool


@dataclass(frozen=True, slots=True)
class BeginPieces:
    """Begin a play; it sounds when `ahead_frames` of it are there, or all."""

    number: int
    channels: tuple[int, ...]
    ahead_frames: int


@dataclass(frozen=True, slots=True)
class Piece:
    """The next frames of that play, float32 (frames, channels)."""

    frames: Float32Array


@dataclass(frozen=True, slots=True)
class EndPieces:
    """No more pieces come."""


@dataclass(frozen=True, slots=True)
class FadeOut:
    """Fade out with the next period."""


def main() -> None:
    """Open a stream and carry out orders until the parent closes the pipe."""
    pipe = pipe_to_parent()
    try:
        code = _serve(pipe)
    except DeviceChoiceError as error:
        pipe.send(OpeningRefused(error.cause, error.remedy, error.absent))
        code = 1
    except OSError:  # the parent is gone
        code = 2
    except Exception:  # a defect: the parent keeps standard error
        traceback.print_exc()
        code = 4
    # The audio library's own clean-up hangs where its host is gone; it would run on any other way out.
    os._exit(code)


def _serve(pipe: MessagePipe) -> int:
    request = pipe.receive()
    if not isinstance(request, StreamRequest):
        return 0
    sounddevice = load_sounddevice()
    stream = WatchedStream(sounddevice, request)
    gc.freeze()
    gc.disable()  # a collection would keep the callback waiting; nothing here makes cycles
    sys.setswitchinterval(0.001)
    pipe.send(Opened(stream.device, stream.latency_s, str(sounddevice.get_portaudio_version()[1])))
    ending, resting = threading.Event(), threading.Event()
    threading.Thread(target=_forward_events, args=(pipe, stream, resting), daemon=True).start()
    threading.Thread(target=_report_loss, args=(pipe, stream, ending), daemon=True).start()
    threading.Thread(target=_rest_when_silent, args=(pipe, stream, resting), daemon=True).start()
    _obey(pipe, stream)
    ending.set()
    # On this thread, which opened the stream: ASIO drivers want it so.
    too_long = threading.Timer(CLOSING_S, os._exit, [0])
    too_long.daemon = True
    too_long.start()
    stream.close()
    return 0


def _obey(pipe: MessagePipe, stream: WatchedStream) -> None:
    """Carry out orders until one says to close or the parent is gone."""
    pieces = _Pieces(stream)
    while (order := pipe.receive()) is not None:
        match order:
            case BeginPieces():
                pieces.begin(order)
            case Piece(frames):
                pieces.add(frames)
            case EndPieces():
                pieces.end()
            case FadeOut():
                pieces.start()
                stream.playback.mute()
            case Ask():
                pipe.send(Clocked(stream.playback.measured_rate_hz))
                pipe.send(Alive())
            case Close():
                return


class _Pieces:
    """A play that comes in pieces: it sounds when enough of it is there, or all."""

    def __init__(self, stream: WatchedStream) -> None:
        self._playback = stream.playback
        self._reserve_frames = round(FADE_S * stream.rate_hz)
        self._play: StreamPlay | None = None
        self._waiting = False
        self._ahead_frames = 0

    def begin(self, order: BeginPieces) -> None:
        self._play = StreamPlay(order.number, order.channels, self._reserve_frames, self._playback.events.put)
        self._ahead_frames, self._waiting = order.ahead_frames, True

    def add(self, frames: Float32Array) -> None:
        if self._play is not None:
            self._play.add(frames)
            if self._play.received >= self._ahead_frames:
                self.start()

    def end(self) -> None:
        if self._play is not None:
            self._play.end()
            self.start()

    def start(self) -> None:
        if self._waiting and self._play is not None:
            self._waiting = False
            self._playback.start(self._play)


def _forward_events(pipe: MessagePipe, stream: WatchedStream, resting: threading.Event) -> None:
    while True:
        event = stream.playback.events.get()
        if not resting.is_set():
            pipe.try_send(event)


def _report_loss(pipe: MessagePipe, stream: WatchedStream, ending: threading.Event) -> None:
    cause = stream.watch(ending.is_set)
    if cause:
        pipe.try_send(Lost(cause))
        os._exit(3)


def _rest_when_silent(pipe: MessagePipe, stream: WatchedStream, resting: threading.Event) -> None:
    """Mute when the parent is stopped, and end: it opens the stream again when it goes on."""
    wait_for_silence(pipe)
    resting.set()  # a play that is muted so has not ended well
    stream.silence()
    time.sleep(stream.latency_s)
    pipe.try_send(Lost(STOPPED, at_rest=True))
    os._exit(3)
