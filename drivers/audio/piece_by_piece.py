"""A play that comes in pieces while it sounds: what the callback takes from, and how it notices that none is left."""

from __future__ import annotations

import queue
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Taken:
    """So many frames of a play have been put into periods."""

    number: int
    frames: int


class PieceByPiece:
    """Frames for some channels, handed over in pieces by one thread and put into periods by the stream's.

    Parameters
    ----------
    number : int
        The play's.
    channels : sequence of int
        Outputs, in the order of the pieces' columns.
    reserve_frames : int
        Fewer than these left, and the end not told: it has run dry, with enough left to fade out over.
    tell : callable
        Told `Taken` after each piece.
    """

    def __init__(
        self, number: int, channels: Sequence[int], reserve_frames: int, tell: Callable[[Taken], None]
    ) -> None:
        self.number = number
        self.done = 0
        self.periods_after = 0
        self.silent_frames = 0
        self.ending: tuple[str, str] | None = None
        self.frames = sys.maxsize
        """Length of it all, once that is known."""
        self.received = 0
        self._channels = list(channels)
        self._reserve_frames = reserve_frames
        self._tell = tell
        self._pieces: queue.SimpleQueue[Float32Array] = queue.SimpleQueue()
        self._piece = np.zeros((0, len(self._channels)), dtype=np.float32)
        self._taken = 0

    def add(self, piece: Float32Array) -> None:
        """Hand over the next frames, (frames, channels), parts of full scale."""
        self._pieces.put(piece)
        self.received += len(piece)

    def end(self) -> None:
        """Say that no more comes."""
        self.frames = self.received

    def put(self, out: Float32Array) -> str:
        """Put what comes next into a silent period; tells what is missing, if anything is."""
        ended = self.frames != sys.maxsize
        dry = not ended and self.received - self._taken < len(out) + self._reserve_frames
        place = 0
        while place < len(out):
            if not len(self._piece):
                try:
                    self._piece = self._pieces.get_nowait()
                except queue.Empty:
                    break
            count = min(len(out) - place, len(self._piece))
            out[place : place + count, self._channels] = self._piece[:count]
            self._piece = self._piece[count:]
            self._taken += count
            place += count
            if not len(self._piece):
                self._tell(Taken(self.number, self._taken))
        return "the next piece of the signal did not come in time" if dry else ""
