"""Drives as they are needed, for playing while they are rendered.

Memory holds a few blocks and the rows' spectra, besides what the sources say of themselves (their signals and path
points); it does not grow with the drives.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.errors import InputError
from rendering.accumulate import SourceDrives
from rendering.between_positions import scene_interpolation
from rendering.drive import chosen_method
from rendering.green_source import GreenSource
from rendering.omission import tolerance_of
from rendering.overlap_add import scale
from rendering.regularisation import BankRows
from rendering.sampling import Method, sample_source
from rendering.scene import Scene
from rendering.upsampling import MULTIPLE

Float64Array = NDArray[np.float64]


@dataclass(slots=True)
class _Source:
    """One source's drives that are not given out yet."""

    pieces: Generator[tuple[int, NDArray[Any], int], None, None]
    ready: Float64Array
    """From the sample that is given out next."""
    done: bool = False


class LiveDrive:
    """The drives of a scene, block by block.

    The same numbers as `rendering.drive.render` gives, but for the order in which several sources are added up.

    Parameters
    ----------
    scene : Scene
        What is to be felt. A limit on the drive cannot be met by scaling, as its largest value is not known yet:
        drives that exceed it are refused when they come.
    bank : GreenSource
        Measured Green's functions.
    block_samples : int
        Samples to give out at a time, > 0.
    method : {"sampled", "exact"}, optional
        As for `render`.
    tolerance_db : float, optional
        As for `render`; what is proved is known at the end.
    gain : float
        Factor by which all is multiplied, such as the scale that an earlier render of the scene was limited by.

    Raises
    ------
    InputError
        As `render` does.
    """

    samples: int
    """Samples of the whole drive."""
    start_s: float
    """Time of the first one."""
    sample_rate_hz: float
    actuators: int
    latency_samples: int
    """How much later than a drive sample the source samples may be that it is made of, lead-in included."""

    def __init__(
        self,
        scene: Scene,
        bank: GreenSource,
        *,
        block_samples: int = 1024,
        method: Method | None = None,
        tolerance_db: float | None = None,
        gain: float = 1.0,
    ) -> None:
        if block_samples < 1:
            raise InputError(f"block_samples is {block_samples}; it must be 1 or more")
        if not np.isfinite(gain):
            raise InputError(f"gain is {gain}; it must be a finite number")
        self._block_samples = block_samples
        self._gain = gain
        self._limit_v = scene.output.limit_v
        tolerance = tolerance_of(tolerance_db)
        kind = scene_interpolation(scene, bank)
        chosen = chosen_method(scene, method)
        sources = [
            sample_source(source, index, kind, sample_rate_hz=bank.sample_rate_hz, taps=bank.taps, method=chosen)
            for index, source in enumerate(scene.sources)
        ]
        self._rows = BankRows(kind.rows_of(bank), scene.regularisation)
        self._makers = [
            SourceDrives(
                source.emission,
                self._rows,
                transform=partial(source.fft_samples, actuators=bank.actuators, multiple=MULTIPLE if tolerance else 1),
                tolerance=tolerance,
                live=True,
                expected_rows=source.expected_rows,
            )
            for source in sources
        ]
        self._naming = [source.naming for source in sources]
        self.samples = max(source.emission.stop_sample for source in sources) + bank.taps - 1
        self.sample_rate_hz, self.actuators = float(bank.sample_rate_hz), bank.actuators
        self.start_s = -(bank.taps - 1) / float(bank.sample_rate_hz)
        self.latency_samples = 2 * max(maker.block_samples for maker in self._makers)

    def blocks(self) -> Iterator[Float64Array]:
        """Give the drives, (actuators, block_samples) at a time, the last block shorter.

        Raises
        ------
        InputError
            A row on the path cannot be used, or a drive exceeds the scene's limit or does not fit into float64.
        """
        actuators = self._rows.bank.actuators
        with ExitStack() as stack:
            sources = []
            for maker in self._makers:
                pieces = stack.enter_context(closing(maker.pieces()))
                sources.append(_Source(pieces, np.zeros((actuators, 0))))
            for first in range(0, self.samples, self._block_samples):
                count = min(self._block_samples, self.samples - first)
                block = np.zeros((actuators, count))
                for index, source in enumerate(sources):
                    self._fill(index, source, first, count)
                    block += source.ready[:, :count]
                    source.ready = source.ready[:, count:].copy()
                block = np.ldexp(block, self._rows.drive_exponent) * self._gain
                self._judge(block, first)
                yield block

    def _fill(self, index: int, source: _Source, first: int, count: int) -> None:
        """Make a source's drives until the next `count` samples from `first` are there."""
        while source.ready.shape[1] < count:
            self._rows.needed_by = self._naming[index]
            piece = None if source.done else next(source.pieces, None)
            if piece is None:
                source.done = True
                silence = np.zeros((len(source.ready), count - source.ready.shape[1]))
                source.ready = np.concatenate([source.ready, silence], axis=1)
                return
            begin, samples, exponent = piece
            have = first + source.ready.shape[1]
            volts = scale(samples, exponent)
            if begin > have:
                volts = np.pad(volts, ((0, 0), (begin - have, 0)))
            source.ready = np.concatenate([source.ready, volts[:, max(have - begin, 0) :]], axis=1)

    def _judge(self, block: Float64Array, first: int) -> None:
        peak_v = float(max(block.max(initial=0.0), -block.min(initial=0.0)))
        if not np.isfinite(peak_v):
            raise InputError(
                f"the drive from sample {first} on does not fit into float64; lower the amplitude or check the bank"
            )
        if self._limit_v is not None and peak_v > self._limit_v:
            raise InputError(
                f"the drive reaches {peak_v:.3g} V from sample {first} on, more than limit_v ({self._limit_v:g});"
                f" lower the gain ({self._gain:g})"
            )
