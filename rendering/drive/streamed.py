"""Drives block by block, for playing while they are rendered, and in two passes for scenes of any length.

Memory holds a few blocks and the rows' spectra, besides the sources' own signals and path points; it does not grow with
the drives.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace

import numpy as np

from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.band import norm_of, relative_bound, tolerance_of
from wavefocus.rendering.drive.accumulate import Accumulated, SourceDrives
from wavefocus.rendering.drive.coil_limits import DriveLimits, Reached, RunningLevels, strictest
from wavefocus.rendering.drive.wav import Interface, InterfaceRate, largest_of
from wavefocus.rendering.greens.interpolation.errors import judged_errors
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.greens.source import GreenSource, apply_exponent
from wavefocus.rendering.report.render_report import RenderReport, report_render
from wavefocus.rendering.scene.model import Scene
from wavefocus.rendering.scene.sampling import Method, SampledScene, sample_scene
from wavefocus.storage.errors import InputError

OnProgress = Callable[[int, int], None]

SUMMED = 1e-9
"""So far beyond a limit, relatively, an rms may come by rounding."""
PIECE_SAMPLES = 4096


class BlockDrive:
    """The drives of a scene, block by block.

    The same numbers as `wavefocus.rendering.drive.rendering.render` gives, but for the order in which sources are added
    up.

    method: As for `render`.
    single: Compute in single precision; the bound on its error is available at the end.
    limits: What no actuator may exceed; by default the scene's. They cannot be met by scaling here, as the largest
        value is not available yet: drives that exceed them are refused when they come.

    Raises InputError: as `render` does.
    """

    sampled: SampledScene
    rows: BankRows
    gain: float = 1.0
    """Factor by which all is multiplied, such as the scale that a first pass found."""
    latency_samples: int
    """How much later than a drive sample the source samples may be that it is made of, lead-in included."""

    def __init__(
        self,
        scene: Scene,
        bank: GreenSource,
        *,
        block_samples: int = 1024,
        method: Method | None = None,
        single: bool = False,
        limits: DriveLimits | None = None,
    ) -> None:
        if block_samples < 1:
            raise InputError(f"block_samples is {block_samples}; it must be 1 or more")
        self._block_samples, self._rate_hz = block_samples, float(bank.sample_rate_hz)
        self.limits = DriveLimits(scene.output.limit_v, scene.output.limit_rms_v) if limits is None else limits
        self.sampled = sample_scene(scene, bank, method)
        self.rows = BankRows(self.sampled.kind.rows_of(bank), scene.regularisation)
        self._makers = [SourceDrives(source, self.rows, single=single, live=True) for source in self.sampled.sources]
        self.shape = bank.actuators, self.sampled.samples
        self.latency_samples = 2 * max(maker.block_samples for maker in self._makers)

    @property
    def accumulated(self) -> list[Accumulated]:
        """What each source cost and left out, when `blocks` came to its end."""
        return [maker.facts for maker in self._makers]

    def blocks(self) -> Iterator[Float64Array]:
        """Give the drives, (actuators, block_samples) at a time, the last block shorter.

        Raises InputError: a row on the path cannot be used, or a drive exceeds a limit or does not fit into float64.
        """
        levels, first = RunningLevels(*self.shape, self._rate_hz, self.limits), 0
        with ExitStack() as stack:
            sources = [stack.enter_context(closing(self._of_source(index))) for index in range(len(self._makers))]
            for parts in zip(*sources, strict=True):
                block = apply_exponent(sum(parts, np.zeros(parts[0].shape)), self.rows.drive_exponent) * self.gain
                self._judge(block, first, levels)
                yield block
                first += block.shape[1]

    def _of_source(self, index: int) -> Generator[Float64Array, None, None]:
        """Drives of one source, block by block, from the first sample of the scene's drives to the last."""
        actuators, samples = self.shape
        ready = np.zeros((actuators, 0))
        with closing(self._makers[index].pieces()) as pieces:
            for first in range(0, samples, self._block_samples):
                count = min(self._block_samples, samples - first)
                while ready.shape[1] < count:
                    self.rows.needed_by = self.sampled.sources[index].naming
                    have = first + ready.shape[1]
                    begin, volts = next(pieces, (have, np.zeros((actuators, first + count - have))))
                    volts = np.pad(volts, ((0, 0), (max(begin - have, 0), 0)))[:, max(have - begin, 0) :]
                    ready = np.concatenate([ready, volts], axis=1)
                yield ready[:, :count]
                ready = ready[:, count:].copy()
            # What is made beyond the last sample is nothing, but the facts are complete only at its end.
            self.rows.needed_by = self.sampled.sources[index].naming
            for _ in pieces:
                pass

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


class StreamedDrive:
    """The drives of a scene in two passes over it: the first finds the scale, the second gives the scaled drives.

    By how much a drive has to be scaled is found when all of it was made. A limiter that acts while it plays would
    change the waveforms, and with them the focus; a bound that is proved before is far from what is reached. Of the
    first pass only levels are kept: largest magnitudes, largest rms over any second, largest magnitudes between samples
    at the interface's rate.

    interface: Outputs whose full scale is not to be exceeded between the samples of the drives either.
    gain: Factor on the drives before they are limited, > 0.
    method, tolerance_db, interpolation_tolerance: As for `wavefocus.rendering.drive.rendering.render_with_report`,
        which raises the same InputErrors.
    """

    def __init__(
        self,
        scene: Scene,
        bank: GreenSource,
        *,
        interface: Interface | None = None,
        gain: float = 1.0,
        block_samples: int = PIECE_SAMPLES,
        method: Method | None = None,
        tolerance_db: float | None = None,
        interpolation_tolerance: float | None = None,
    ) -> None:
        if not (math.isfinite(gain) and gain > 0):
            raise InputError(f"gain is {gain}; it must be a finite number above 0")
        self._scene, self._bank, self._interface = scene, bank, interface
        self._gain, self._block_samples, self._method = gain, block_samples, method
        self._tolerance, self._interpolation_tolerance = tolerance_of(tolerance_db), interpolation_tolerance
        self._limits = DriveLimits(scene.output.limit_v, scene.output.limit_rms_v)
        self._rate = None if interface is None else InterfaceRate(float(bank.sample_rate_hz), interface.rate_hz)
        self._report: RenderReport | None = None
        self.live = self._live(single=self._tolerance > 0)

    @property
    def shape(self) -> tuple[int, int]:
        """Actuators and samples of the whole drive."""
        return self.live.shape

    @property
    def peak_v(self) -> float:
        """Largest magnitude of the drives that `blocks` gives."""
        return float(self._levels.peaks_v.max()) * self.live.gain

    def prepare(self, on_progress: OnProgress | None = None) -> RenderReport:
        """Make all drives once and find by how much they have to be scaled; the figures are those of `render`.

        on_progress: Called with samples done and samples in all.
        """
        signals = [source.signal for source in self.live.sampled.sources]
        errors, remarks = judged_errors(
            self._scene, self._bank, self.live.sampled.kind, signals, self._interpolation_tolerance
        )
        for single in (True, False) if self._tolerance > 0 else (False,):
            if self._tolerance > 0 and not single:
                self.live = self._live(single=False)
            reached = self._pass(on_progress)
            error = math.fsum(item.error for item in self.live.accumulated)
            norms = apply_exponent(self._levels.norms, -self.live.rows.drive_exponent)
            bound = relative_bound(error, norm_of(norms))
            if bound <= self._tolerance:
                break
        limiting = strictest([replace(one, each_v=one.each_v * self._gain) for one in reached])
        self.live.gain = self._gain * limiting.scale
        self.live.limits = self._limits
        self._report = report_render(
            self._scene, self.live.rows, self.live.sampled.sources, self.live.accumulated, self._levels.norms,
            limiting=limiting, omitted_bound=bound, errors=errors, remarks=remarks,
        )  # fmt: skip
        return self._report

    def blocks(self) -> Iterator[Float64Array]:
        """Give the drives within their limits, (actuators, block_samples) at a time; `prepare` comes first."""
        if self._report is None:
            raise RuntimeError("the first pass is not done")
        return self.live.blocks()

    def _live(self, *, single: bool) -> BlockDrive:
        return BlockDrive(
            self._scene, self._bank, block_samples=self._block_samples, method=self._method, limits=DriveLimits(),
            single=single,
        )  # fmt: skip

    def _pass(self, on_progress: OnProgress | None) -> list[Reached]:
        """Make all drives and keep the levels that they reach."""
        actuators, samples = self.live.shape
        self._levels = RunningLevels(actuators, samples, float(self._bank.sample_rate_hz), self._limits)
        passing = self._watched(self.live.blocks(), on_progress)
        if self._rate is None or self._interface is None:
            for _ in passing:
                pass
            return self._levels.reached()
        pieces = self._rate.pieces(passing, actuators, samples, PIECE_SAMPLES)
        reached = largest_of(pieces, actuators)
        return [*self._levels.reached(), self._interface.reached(reached)]

    def _watched(self, blocks: Iterable[Float64Array], on_progress: OnProgress | None) -> Iterator[Float64Array]:
        done = 0
        for block in blocks:
            self._levels.add(block)
            done += block.shape[1]
            yield block
            if on_progress is not None:
                on_progress(done, self.live.shape[1])
