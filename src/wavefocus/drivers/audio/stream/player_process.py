"""The process that owns the audio stream: it can be killed when a driver hangs, and ends, muted, with its parent.

Its first message is a `StreamRequest`; then "opened", the device, its latency in s and PortAudio's version, or
"refused", cause, remedy, and whether it may yet come. Orders: "begin", number, channels, and how many frames are there
when it sounds; "piece", float32 (frames, channels); "end": no more pieces; "fade" out with the next period. Answers,
besides those of `Playback`: "clocked" and the rate of the callbacks by the computer's clock in Hz, NaN while it is not
known.
"""

import gc
import os
import sys
import threading
import time
import traceback
from typing import Any

from wavefocus.drivers.audio.stream import (
    FADE_S,
    DeviceChoiceError,
    StreamPlay,
    StreamRequest,
    WatchedStream,
)
from wavefocus.drivers.process import ALIVE, ASK, AT_REST, CLOSE, MessagePipe, pipe_to_parent, wait_for_silence

_CLOSING_S = 3.0
"""Closing a stream whose host is gone hangs, and JACK takes a period for each channel; then the process just ends."""


def main() -> None:
    """Open a stream and carry out orders until the parent closes the pipe."""
    pipe = pipe_to_parent()
    try:
        code = _serve(pipe)
    except DeviceChoiceError as error:
        pipe.send(("refused", error.cause, error.remedy, error.absent))
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
    sounddevice = _load_sounddevice()
    stream = WatchedStream(sounddevice, request)
    gc.freeze()
    gc.disable()  # a collection would keep the callback waiting; nothing here makes cycles
    sys.setswitchinterval(0.001)
    pipe.send(("opened", stream.device, stream.latency_s, str(sounddevice.get_portaudio_version()[1])))
    ending, resting = threading.Event(), threading.Event()
    threading.Thread(target=_forward_events, args=(pipe, stream, resting), daemon=True).start()
    threading.Thread(target=_report_loss, args=(pipe, stream, ending), daemon=True).start()
    threading.Thread(target=_rest_when_silent, args=(pipe, stream, resting), daemon=True).start()
    _obey(pipe, stream)
    ending.set()
    # On this thread, which opened the stream: ASIO drivers want it so.
    too_long = threading.Timer(_CLOSING_S, os._exit, [0])
    too_long.daemon = True
    too_long.start()
    stream.close()
    return 0


def _load_sounddevice() -> Any:
    """The package with the PortAudio library that it drives. Raises DeviceChoiceError."""
    os.environ["SD_ENABLE_ASIO"] = "1"  # Windows: outputs of more than two channels are rarely offered otherwise
    try:
        import sounddevice
    except ImportError as error:
        raise DeviceChoiceError(
            f"the Python package sounddevice is missing ({error})", "install it: pip install sounddevice"
        ) from error
    except OSError as error:
        raise DeviceChoiceError(
            f"the PortAudio library is missing or broken ({error})",
            "install it: on Debian and Ubuntu apt install libportaudio2, elsewhere reinstall the package sounddevice",
        ) from error
    return sounddevice


def _obey(pipe: MessagePipe, stream: WatchedStream) -> None:
    """Carry out orders until one says to close or the parent is gone."""
    playback = stream.playback
    play: StreamPlay | None = None
    ahead_frames, waits = 0, False
    while (order := pipe.receive()) not in (None, CLOSE):
        match order:
            case ("begin", number, channels, ahead_frames):
                play = StreamPlay(number, channels, round(FADE_S * stream.rate_hz), playback.events.put)
                waits = True
            case ("piece", frames) if play is not None:
                play.add(frames)
            case ("end",) if play is not None:
                play.end()
            case str() if order == ASK:
                pipe.send(("clocked", playback.measured_rate_hz))
                pipe.send(ALIVE)
        if play is not None and waits and (play.received >= ahead_frames or play.is_whole or order == "fade"):
            waits = False
            playback.start(play)
        if order == "fade":
            playback.mute()


def _forward_events(pipe: MessagePipe, stream: WatchedStream, resting: threading.Event) -> None:
    while True:
        event = stream.playback.events.get()
        if not resting.is_set():
            pipe.try_send(event)


def _report_loss(pipe: MessagePipe, stream: WatchedStream, ending: threading.Event) -> None:
    cause = stream.watch(ending.is_set)
    if cause:
        pipe.try_send(("lost", cause, False))
        os._exit(3)


def _rest_when_silent(pipe: MessagePipe, stream: WatchedStream, resting: threading.Event) -> None:
    """Mute when the parent is stopped, and end: it opens the stream again when it goes on."""
    wait_for_silence(pipe)
    resting.set()  # a play that is muted so has not ended well
    stream.silence()
    time.sleep(stream.latency_s)
    pipe.try_send(AT_REST)
    os._exit(3)
