"""Drives as they are needed, for playing while they are rendered.

Memory holds a few blocks and the rows' spectra, besides what the sources say of themselves (their signals and path
points); it does not grow with the drives.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rendering.band import tolerance_of
from rendering.drive.accumulate import Accumulated, SourceDrives
from rendering.drive.coil_limits import DriveLimits, RunningLevels
from rendering.drive.rendering import chosen_method
from rendering.greens.bank_rows import BankRows
from rendering.greens.source import GreenSource
from rendering.scene.model import Scene
from rendering.scene.sampling import Method, SampledSource, sample_scene
from storage.errors import InputError

Float64Array = NDArray[np.float64]

SUMMED = 1e-9
"""So far beyond a limit, relatively, an rms may come by rounding."""


@dataclass(slots=True)
class _Source:
    """One source's drives that are not given out yet."""

    pieces: Generator[tuple[int, Float64Array], None, None]
    ready: Float64Array
    """From the sample that is given out next."""
    done: bool = False


class LiveDrive:
    """The drives of a scene, block by block.

    The same numbers as `rendering.drive.rendering.render` gives, but for the order in which sources are added up.

    block_samples: Samples to give out at a time, > 0.
    method, {"sampled", "exact"}: As for `render`.
    tolerance_db: As for `render`; the bound is available at the end.
    gain: Factor by which all is multiplied, such as the scale that a first pass found
        (`rendering.drive.streamed_drive`).
    limits: What no actuator may exceed; by default the scene's. They cannot be met by scaling here, as the largest
        value is not available yet: drives that exceed them are refused when they come.

    Raises InputError: as `render` does.
    """

    samples: int
    """Samples of the whole drive."""
    gain: float
    """May be changed before `blocks` is called again."""
    limits: DriveLimits
    """Likewise."""
    sources: list[SampledSource]
    rows: BankRows
    method: Method
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
        limits: DriveLimits | None = None,
    ) -> None:
        if block_samples < 1:
            raise InputError(f"block_samples is {block_samples}; it must be 1 or more")
        if not np.isfinite(gain):
            raise InputError(f"gain is {gain}; it must be a finite number")
        self._block_samples = block_samples
        self.gain = gain
        self.limits = DriveLimits(scene.output.limit_v, scene.output.limit_rms_v) if limits is None else limits
        tolerance = tolerance_of(tolerance_db)
        chosen = chosen_method(scene, method)
        kind, sources = sample_scene(scene, bank, chosen)
        self.sources, self.method = sources, chosen
        self.rows = BankRows(kind.rows_of(bank), scene.regularisation)
        self._makers = [
            SourceDrives(
                source.emission,
                self.rows,
                fft_samples=source.fft_samples(bank.taps, bank.actuators),
                tolerance=tolerance,
                band_hz=self.rows.bank.band_hz,
                live=True,
            )
            for source in sources
        ]
        self.samples = max(source.emission.stop_sample for source in sources) + bank.taps - 1
        self.sample_rate_hz, self.actuators = float(bank.sample_rate_hz), bank.actuators
        self.start_s = -(bank.taps - 1) / float(bank.sample_rate_hz)
        self.latency_samples = 2 * max(maker.block_samples for maker in self._makers)

    @property
    def accumulated(self) -> list[Accumulated]:
        """What each source cost and left out, when `blocks` came to its end."""
        return [maker.facts for maker in self._makers]

    def blocks(self) -> Iterator[Float64Array]:
        """Give the drives, (actuators, block_samples) at a time, the last block shorter.

        Raises InputError: a row on the path cannot be used, or a drive exceeds a limit or does not fit into float64.
        """
        levels = RunningLevels(self.actuators, self.samples, self.sample_rate_hz, self.limits)
        with ExitStack() as stack:
            sources = []
            for maker in self._makers:
                pieces = stack.enter_context(closing(maker.pieces()))
                sources.append(_Source(pieces, np.zeros((self.actuators, 0))))
            for first in range(0, self.samples, self._block_samples):
                count = min(self._block_samples, self.samples - first)
                block = np.zeros((self.actuators, count))
                for index, source in enumerate(sources):
                    self._fill(index, source, first, count)
                    block += source.ready[:, :count]
                    source.ready = source.ready[:, count:].copy()
                block = np.ldexp(block, self.rows.drive_exponent) * self.gain
                self._judge(block, first, levels)
                yield block
            for index, source in enumerate(sources):
                # What is made beyond the last sample is nothing, but the facts are complete only at its end.
                self.rows.needed_by = self.sources[index].naming
                while next(source.pieces, None) is not None:
                    pass

    def _fill(self, index: int, source: _Source, first: int, count: int) -> None:
        """Make a source's drives until the next `count` samples from `first` are there."""
        while source.ready.shape[1] < count:
            self.rows.needed_by = self.sources[index].naming
            piece = None if source.done else next(source.pieces, None)
            if piece is None:
                source.done = True
                silence = np.zeros((len(source.ready), count - source.ready.shape[1]))
                source.ready = np.concatenate([source.ready, silence], axis=1)
                return
            begin, volts = piece
            have = first + source.ready.shape[1]
            if begin > have:
                volts = np.pad(volts, ((0, 0), (begin - have, 0)))
            source.ready = np.concatenate([source.ready, volts[:, max(have - begin, 0) :]], axis=1)

    def _judge(self, block: Float64Array, first: int, levels: RunningLevels) -> None:
        if not np.isfinite(block).all():
            raise InputError(
                f"the drive from sample {first} on does not fit into float64; lower the amplitude or check the bank"
            )
        if self.limits.peak_v is None and self.limits.rms_v is None:
            return
        levels.add(block)
        for one in levels.reached():
            most_v = float(one.each_v.max())
            if most_v > one.limit_v * (1.0 + (SUMMED if one.summed else 0.0)):
                raise InputError(
                    f"the drive reaches {most_v:.3g} V{' rms' if one.summed else ''} from sample {first} on, more than"
                    f" {one.key} ({one.limit_v:g}); lower the gain ({self.gain:g})"
                )
