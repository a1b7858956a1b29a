"""The process that owns the audio stream: it can be killed when a driver hangs, and ends, muted, with its parent.

Run as ``python -P -m drivers.audio.player_process`` with pipes for input and output; see `stream_player`.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import traceback
from dataclasses import asdict

import numpy as np

from drivers.audio.playback import FADE_S, Ended, Float32Array, PieceByPiece, Play, Voice
from drivers.audio.portaudio import DeviceChoiceError, StreamRequest, WatchedStream, load_sounddevice
from drivers.process import Message, MessagePipe

CLOSING_S = 3.0
"""Closing a stream whose host is gone hangs, and JACK takes a period for each channel; then the process just ends."""


def main() -> None:
    """Do what comes over the pipe until it ends."""
    # Ctrl-C reaches every process of a terminal; the parent decides what stops, and when.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Audio libraries print where they please; the answers go where nothing else does.
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb", buffering=0)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    pipe = MessagePipe(sys.stdin.buffer, answers)
    try:
        code = _serve(pipe)
    except DeviceChoiceError as error:
        pipe.send({"is": "failed", "cause": error.cause, "remedy": error.remedy, "absent": error.absent})
        code = 1
    except OSError:  # the parent is gone, and with it who could be told
        code = 2
    except Exception:  # a defect: what the parent keeps of standard error tells where
        traceback.print_exc()
        code = 4
    # The audio library's own clean-up hangs where its host is gone; it would run on any other way out.
    os._exit(code)


def _serve(pipe: MessagePipe) -> int:
    received = pipe.receive()
    if received is None:
        return 0
    request, _ = received
    sounddevice = load_sounddevice()
    stream = WatchedStream(sounddevice, StreamRequest(**request))
    gc.freeze()
    gc.disable()  # a collection would keep the callback waiting; nothing here makes cycles
    sys.setswitchinterval(0.001)
    pipe.send(
        {
            "is": "open",
            "device": asdict(stream.device),
            "latency_s": stream.latency_s,
            "library": str(sounddevice.get_portaudio_version()[1]),
        }
    )
    ending = threading.Event()
    threading.Thread(target=_tell_ends, args=(pipe, stream), daemon=True).start()
    threading.Thread(target=_tell_loss, args=(pipe, stream, ending), daemon=True).start()
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
    signals: dict[int, Float32Array] = {}
    pieces = _Pieces(stream)
    while (received := pipe.receive()) is not None:
        message, payload = received
        order = message["do"]
        if order == "play":
            voices = tuple(Voice(channel, signals[name], start) for channel, name, start in message["voices"])
            stream.playback.start(Play(message["number"], voices))
        elif order == "store":
            signals[message["signal"]] = np.frombuffer(payload, dtype=np.float32)
        elif order == "forget":
            del signals[message["signal"]]
        elif order == "begin":
            pieces.begin(message["number"], message["channels"], message["ahead"])
        elif order == "piece":
            pieces.add(np.frombuffer(payload, dtype=np.float32))
        elif order == "end":
            pieces.end()
        elif order == "mute":
            pieces.start()
            stream.playback.mute()
        elif order == "ask":
            pipe.send({"is": "here", "callbacks": stream.playback.callbacks, "underflows": stream.playback.underflows})
        elif order == "close":
            return


class _Pieces:
    """A play that comes in pieces: it sounds from when enough of it is there, or all."""

    def __init__(self, stream: WatchedStream) -> None:
        self._playback = stream.playback
        self._reserve_frames = round(FADE_S * stream.rate_hz)
        self._play: PieceByPiece | None = None
        self._waiting = False
        self._columns = self._ahead_frames = 0

    def begin(self, number: int, channels: list[int], ahead_frames: int) -> None:
        self._play = PieceByPiece(number, channels, self._reserve_frames, self._playback.events.put)
        self._columns, self._ahead_frames, self._waiting = len(channels), ahead_frames, True

    def add(self, values: Float32Array) -> None:
        if self._play is not None:
            self._play.add(values.reshape(-1, self._columns))
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


def _tell_ends(pipe: MessagePipe, stream: WatchedStream) -> None:
    while True:
        event = stream.playback.events.get()
        _send_if_heard(pipe, {"is": "ended" if isinstance(event, Ended) else "taken", **asdict(event)})


def _tell_loss(pipe: MessagePipe, stream: WatchedStream, ending: threading.Event) -> None:
    cause = stream.watch(ending.is_set)
    if cause:
        _send_if_heard(pipe, {"is": "lost", "cause": cause})
        os._exit(3)


def _send_if_heard(pipe: MessagePipe, message: Message) -> None:
    try:
        pipe.send(message)
    except OSError:  # the parent is gone; the main thread sees it too, and ends the process in good order
        return


if __name__ == "__main__":
    main()
