"""A play whose signal is handed over in pieces while it sounds, as the player's side of the pipe sees it."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drivers.audio.playback import UNDERFLOW
from drivers.audio.stream_life import PlayUnderWay, StreamLife, lost
from drivers.driver_process import ProcessGoneError
from drivers.errors import InstrumentError, TransientInstrumentError

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
