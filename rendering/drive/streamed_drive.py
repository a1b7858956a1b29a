"""Scenes of any length in constant memory: a first pass finds the scale, a second one gives the scaled drives.

By how much a drive has to be scaled is known when all of it is known. A limiter that acts while it plays would
change the waveforms, and with them the focus; a bound that is proved before is far from what is reached. So the drives
are made twice, and the first time only their levels are kept: largest magnitudes, largest rms over any second, largest
magnitudes between their samples at the interface's rate. What is given out is the drive of
`rendering.drive.rendering.render`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.blas import one_blas_thread
from rendering.band import norm_of, relative_bound, tolerance_of
from rendering.drive.coil_limits import DriveLimits, Reached, RunningLevels, strictest
from rendering.drive.live import LiveDrive
from rendering.drive.rendering import STRICTER
from rendering.drive.wav import Interface, InterfaceRate, largest_of
from rendering.greens.interpolation.errors import interpolation_errors, judge_interpolation
from rendering.greens.interpolation.registry import scene_interpolation
from rendering.greens.source import GreenSource
from rendering.report.render_report import RenderReport, report_render
from rendering.scene.model import Scene
from rendering.scene.sampling import Method
from storage.errors import InputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]
OnProgress = Callable[[int, int], None]

PIECE_SAMPLES = 4096


class StreamedDrive:
    """The drives of a scene in two passes over it.

    scene: What is to be felt, with its limits.
    interface: Outputs whose full scale is not to be exceeded between the samples of the drives either.
    gain: Factor on the drives before they are limited, > 0.
    block_samples: Samples to give out at a time, > 0.
    method, tolerance_db, interpolation_tolerance: As for `rendering.drive.rendering.render_with_report`.

    Raises InputError: as `rendering.drive.rendering.render_with_report` does.
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
        self._scene = scene
        self._bank = bank
        self._interface = interface
        self._rate = None if interface is None else InterfaceRate(float(bank.sample_rate_hz), interface.rate_hz)
        self._gain = gain
        self._block_samples = block_samples
        self._method = method
        self._tolerance = tolerance_of(tolerance_db)
        self._thorough = interpolation_tolerance
        self._limits = DriveLimits(scene.output.limit_v, scene.output.limit_rms_v)
        self._report: RenderReport | None = None
        self.live = self._live(STRICTER[0])

    @property
    def shape(self) -> tuple[int, int]:
        """Actuators and samples of the whole drive."""
        return self.live.actuators, self.live.samples

    @property
    def report(self) -> RenderReport:
        """What the first pass found, with the same figures as of a render in one piece."""
        if self._report is None:
            raise RuntimeError("the first pass is not done")
        return self._report

    @property
    def foci(self) -> tuple[Int64Array, Int64Array, Int64Array]:
        """Sample, bank row and source of each focus, source by source."""
        sources = self.live.sources
        return (
            np.concatenate([source.focus_sample for source in sources]),
            np.concatenate([source.focus_position for source in sources]),
            np.concatenate([np.full(len(one.focus_sample), one.index, dtype=np.int64) for one in sources]),
        )

    @property
    def peak_v(self) -> float:
        """Largest magnitude of the drives that `blocks` gives."""
        return float(self._levels.peaks_v.max()) * self.live.gain

    def prepare(self, on_progress: OnProgress | None = None) -> RenderReport:
        """Make all drives once and find by how much they have to be scaled.

        on_progress: Called with samples done and samples in all.
        """
        scene, bank = self._scene, self._bank
        kind = scene_interpolation(scene, bank)
        signals = [source.signal for source in self.live.sources]
        with one_blas_thread():
            errors = interpolation_errors(scene, bank, kind, signals, thorough=self._thorough is not None)
        remarks = judge_interpolation(errors, self._thorough)
        for share in STRICTER if self._tolerance > 0 else (0.0,):
            if share != STRICTER[0]:
                self.live = self._live(share)
            reached = self._pass(on_progress)
            error = math.fsum(item.error for item in self.live.accumulated)
            with np.errstate(over="ignore", under="ignore"):
                norms = np.ldexp(self._levels.norms, -self.live.rows.drive_exponent)
            bound = relative_bound(error, norm_of(norms))
            if bound <= self._tolerance:
                break
        limiting = strictest([replace(one, each_v=one.each_v * self._gain) for one in reached])
        self.live.gain = self._gain * limiting.scale
        self.live.limits = self._limits
        self._report = report_render(
            scene, self.live.rows, self.live.sources, self.live.accumulated, self._levels.norms,
            limiting=limiting, omitted_bound=bound, errors=errors, remarks=remarks,
        )  # fmt: skip
        return self._report

    def blocks(self) -> Iterator[Float64Array]:
        """Give the drives within their limits, (actuators, block_samples) at a time; `prepare` comes first."""
        if self._report is None:
            raise RuntimeError("the first pass is not done")
        return self.live.blocks()

    def _live(self, share: float) -> LiveDrive:
        left_out = share * self._tolerance
        return LiveDrive(
            self._scene,
            self._bank,
            block_samples=self._block_samples,
            method=self._method,
            tolerance_db=20.0 * math.log10(left_out) if left_out > 0 else None,
            limits=DriveLimits(),
        )

    def _pass(self, on_progress: OnProgress | None) -> list[Reached]:
        """Make all drives; what they reach is kept, they are not."""
        live = self.live
        self._levels = RunningLevels(live.actuators, live.samples, live.sample_rate_hz, self._limits)
        passing = self._watched(live.blocks(), on_progress)
        if self._rate is None or self._interface is None:
            for _ in passing:
                pass
            return self._levels.reached()
        pieces = self._rate.pieces(passing, live.actuators, live.samples, PIECE_SAMPLES)
        reached = largest_of(pieces, live.actuators)
        return [*self._levels.reached(), self._interface.reached(reached)]

    def _watched(self, blocks: Iterable[Float64Array], on_progress: OnProgress | None) -> Iterator[Float64Array]:
        done = 0
        for block in blocks:
            self._levels.add(block)
            done += block.shape[1]
            yield block
            if on_progress is not None:
                on_progress(done, self.live.samples)
