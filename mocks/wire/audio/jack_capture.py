"""What has left the outputs of an emulated audio interface."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mocks.wire.audio.audio_ring import CYCLES, INTERRUPTIONS, NANOSECONDS, AudioRing

Float32Array = NDArray[np.float32]


HELD_NS = 30 * NANOSECONDS
"""How long one relation of frames and time is held: longer than a record, shorter than two clocks take to part."""

LATE_S = 10.0
"""How late frames may come on a busy machine."""


class AudioNotCapturedError(Exception):
    """Frames that were asked for are not to be had: too old, or the capture is gone."""


class PlayedAudio:
    """What has left the outputs, by frames of the audio clock; safe to share between threads.

    The clock goes on whatever happens. While the audio server is frozen or down, nothing leaves the outputs: those
    frames are silent, and listed in `interruptions`.

    ring: Filled by the process that is the interface.
    alive: Whether that process is.
    """

    def __init__(self, ring: AudioRing, alive: Callable[[], bool]) -> None:
        self._ring = ring
        self._alive = alive
        self.rate_hz = ring["rate_hz"]
        self.channels = ring["channels"]
        self._held: tuple[int, int, int] | None = None
        self._lock = threading.Lock()

    def frame_at(self, instant_ns: int) -> float:
        """The frame that sounds at an instant of `time.monotonic_ns`.

        A frame sounds one period after the server asked for it, as with an interface that plays one half of its
        buffer while the other is filled. The slope is `rate_hz`, exactly. The relation is measured anew only when
        it is asked for an instant more than 30 s from the last measurement, and then moves by what the two clocks
        have parted, or after an interruption.
        """
        ring = self._ring
        with self._lock:
            revision = ring["revision"]
            held = self._held
            if held is None or abs(instant_ns - held[1]) > HELD_NS or held[2] != revision:
                frame, start_ns = self._newest_cycle()
                self._held = held = (frame, start_ns, revision)
        return held[0] - ring["period_frames"] + (instant_ns - held[1]) * self.rate_hz / NANOSECONDS

    @property
    def interruptions(self) -> tuple[tuple[int, int], ...]:
        """The frame of each of the last 256 interruptions, and how long nothing left the outputs.

        0 frames where the server says that a cycle was late: its clock stood still, and no sample was lost.
        """
        count = self._ring["interruptions"]
        numbers = range(max(0, count - INTERRUPTIONS), count)
        gaps = self._ring.gaps[[number % INTERRUPTIONS for number in numbers]]
        return tuple((int(first), int(frames)) for first, frames in gaps)

    def read(self, first_frame: int, stop_frame: int) -> Float32Array:
        """Frames as parts of full scale, once the last one is there. Raises AudioNotCapturedError.

        first_frame, stop_frame: Which frames; those before the interface was there, below 0, are silent.

        Returns float32 (channels, stop_frame - first_frame).
        """
        out = np.zeros((self.channels, stop_frame - first_frame), dtype=np.float32)
        first, stop = max(0, first_frame), max(0, stop_frame)
        stop = min(stop, self._wait_for(stop))
        if first < stop:
            oldest = self._ring["written"] - self._ring["ring_frames"]
            if first >= oldest:
                out[:, first - first_frame : stop - first_frame] = self._ring.read(first, stop)
            # A cycle more, because the next one may have been on its way into the ring meanwhile.
            oldest = self._ring["written"] + self._ring["period_frames"] - self._ring["ring_frames"]
            if first < oldest:
                raise AudioNotCapturedError(f"frame {first} is gone, the oldest is {oldest}: keep more seconds")
        return out

    def _wait_for(self, stop: int) -> int:
        """Wait for frames; how many there are, fewer only if the rest are silent."""
        latest_s = None
        while (written := self._ring["written"]) < stop:
            silent = bool(self._ring["silent"])
            missing_s = (stop - self.frame_at(time.monotonic_ns())) / self.rate_hz
            if silent and missing_s <= 0 and self._ring["silent"]:
                return written
            now_s = time.monotonic()
            latest_s = latest_s or now_s + max(0.0, missing_s) + LATE_S
            if not self._alive():
                raise AudioNotCapturedError("the process that records the audio is gone")
            if now_s > latest_s:
                raise AudioNotCapturedError(f"frame {stop} is {LATE_S:g} s late, {written} are there")
            time.sleep(min(max(missing_s, 0.001), 0.02))
        return written

    def _newest_cycle(self) -> tuple[int, int]:
        while True:
            cycle = self._ring["cycle"]
            frame, start_ns = self._ring.cycles[(cycle - 1) % CYCLES]
            if self._ring["cycle"] - cycle < CYCLES - 1:  # it was not overwritten in between
                return int(frame), int(start_ns)
