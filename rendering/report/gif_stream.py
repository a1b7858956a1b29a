"""A GIF written frame by frame: memory holds one of them, however long the movie is."""

from __future__ import annotations

import struct
from types import TracebackType
from typing import TYPE_CHECKING, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

COLOURS = 256
CENTISECONDS = 100


class GifStream:
    """Writes an endless GIF; a context manager.

    All frames have the first one's palette, and parts of a frame replace what was there.

    Parameters
    ----------
    file : BinaryIO
        Where to, from its present place.
    first : uint8 array, shape (height, width, 3)
        The first frame, and what the others are drawn upon.
    palette_of : uint8 array, shape (height, width, 3)
        A picture that has all the colours that will be needed.
    frame_rate_hz : float
        Frames a second; GIF counts in hundredths of a second, at least 2.
    """

    def __init__(
        self,
        file: BinaryIO,
        first: NDArray[np.uint8],
        palette_of: NDArray[np.uint8],
        frame_rate_hz: float,
    ) -> None:
        from PIL import Image

        self._file = file
        self._delay = max(2, round(CENTISECONDS / frame_rate_hz))
        self._palette: Picture = Image.fromarray(palette_of).quantize(COLOURS, method=Image.Quantize.MEDIANCUT)
        colours = bytes(self._palette.getpalette() or b"").ljust(3 * COLOURS, b"\0")
        height, width = first.shape[:2]
        file.write(b"GIF89a" + struct.pack("<HHBBB", width, height, 0b1111_0111, 0, 0) + colours)
        file.write(b"\x21\xff\x0bNETSCAPE2.0\x03\x01" + struct.pack("<H", 0) + b"\0")
        self.add(first)

    def add(self, pixels: NDArray[np.uint8], left: int = 0, top: int = 0) -> None:
        """Add a frame that changes a part of the picture.

        Parameters
        ----------
        pixels : uint8 array, shape (height, width, 3)
            The part.
        left, top : int
            Where it is.
        """
        from PIL import GifImagePlugin, Image

        part = Image.fromarray(pixels).quantize(palette=self._palette, dither=Image.Dither.NONE)
        milliseconds = 1000 // CENTISECONDS * self._delay
        for data in GifImagePlugin.getdata(part, (left, top), duration=milliseconds, disposal=1):
            self._file.write(data)

    @property
    def frame_rate_hz(self) -> float:
        """The rate that the hundredths of a second come to."""
        return CENTISECONDS / self._delay

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.write(b";")
