"""Scenes into drives: eqs. (9) and (16) over a measured bank, block by block, within limits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.band import relative_bound, tolerance_of
from wavefocus.rendering.device import Device
from wavefocus.rendering.drive.accumulate import BLOCKS_AHEAD, BlockAccumulator
from wavefocus.rendering.drive.coil_limits import DriveLimits, RunningLevels, require_finite, rms_window, strictest
from wavefocus.rendering.drive.wav import Interface, InterfaceRate, largest_of
from wavefocus.rendering.greens.interpolation.errors import judged_errors
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.greens.source import GreenSource, drive_unit
from wavefocus.rendering.report.render_report import RenderReport, report_render
from wavefocus.rendering.scene.model import Scene
from wavefocus.rendering.scene.quiet_places import places_of
from wavefocus.rendering.scene.sampling import Method, SampledScene, sample_scene
from wavefocus.storage.drive_file import Drive, drive_in_blocks
from wavefocus.storage.errors import InputError
from wavefocus.storage.units import limited_unit

if TYPE_CHECKING:
    from wavefocus.rendering.drive.quiet_scene import QuietRows

OnProgress = Callable[[int, int], None]
Put = Callable[[int, Float64Array], None]
"""Takes the first sample of a block, and the block."""

MAX_WHOLE_BYTES = 2 * 2**30
"""Drives that take more are never held in memory whole: 22 minutes on 20 actuators at 10 kHz."""


class SceneRenderer:
    """The drives of a scene, block by block, scaled by one factor to stay within its limits.

    By how much a drive has to be scaled is found when all of it was made. A limiter that acts while it plays would
    change the waveforms, and with them the focus; a bound that is proved before is far from what is reached. So all
    drives are made unscaled and multiplied then: `collect` in memory, `write` in the file. Beside the drives, memory
    holds some blocks, the spectra of rows, and the sources' own signals and path points.

    The drive starts at -(L - 1) samples of scene time, L the taps of the bank, even if all sources start later, and
    ends with the last emitted sample; with quiet places, 0.05 to 0.2 s later. A continuous emission lasts until n_M,
    silence included.

    method: Eq. (16) or eq. (9), see `sample_scene`.
    tolerance_db: Allows single precision as long as the proved bound on the relative L2 error of the drives stays below
        it, < 0. Without it all is computed in double precision, to 1e-12 of direct evaluation.
    interface: Outputs whose full scale is not to be exceeded between the samples of the drives either, as long as the
        limits keep the samples themselves within it.
    device: Where to compute, by the array API; by default on this processor.

    Raises InputError: the scene does not fit the bank, or a parameter is out of range.
    """

    sampled: SampledScene
    shape: tuple[int, int]
    """Actuators and samples of the whole drive."""
    report: RenderReport
    """Figures of the render, once all drives were made."""

    def __init__(
        self,
        scene: Scene,
        bank: GreenSource,
        *,
        method: Method | None = None,
        tolerance_db: float | None = None,
        interface: Interface | None = None,
        device: Device | None = None,
    ) -> None:
        self._scene, self._bank, self._device = scene, bank, device
        self._tolerance = tolerance_of(tolerance_db)
        if device is not None and tolerance_db is not None:
            raise InputError("--device cuda does not go with --tolerance-db")
        self._limits = DriveLimits(scene.output.limit_v, scene.output.limit_rms_v)
        self._interface, self._rate_hz = interface, float(bank.sample_rate_hz)
        self._rate = None if interface is None else InterfaceRate(self._rate_hz, interface.rate_hz)
        self.sampled = sample_scene(scene, bank, method)
        self._quiet: QuietRows | None = None
        if places_of(scene):
            from wavefocus.rendering.drive.quiet_scene import quiet_scene  # only such scenes wait for it

            self.sampled, self._quiet = quiet_scene(scene, bank, self.sampled)
        self._rows = self._quiet or BankRows(
            self.sampled.interpolation.rows_of(bank), scene.regularisation, self.sampled.naming
        )
        self.shape = bank.actuators, self.sampled.samples
        self._single = self._tolerance > 0
        self._accumulator = self._new_accumulator()

    @property
    def peak_v(self) -> float:
        """Largest magnitude of the drives within their limits."""
        return float(self._levels.peaks_v.max()) * self.report.scale

    def collect(self, on_progress: OnProgress | None = None) -> Drive:
        """Make all drives in memory.

        on_progress: Called with samples done and samples in all.

        Raises InputError: a row on a path cannot be used, a drive does not fit into float64, or all into memory.
        """
        try:
            drive_v = np.empty(self.shape)

            def put(first: int, block: Float64Array) -> None:
                drive_v[:, first : first + block.shape[1]] = block

            report = self._prepared(on_progress, put, lambda: drive_v)
        except MemoryError as error:
            size = 8 * self.shape[0] * self.shape[1] / 2**30
            raise InputError(
                f"the drive takes {size:.3g} GiB, which do not fit into memory; shorten the scene"
            ) from error
        if report.scale != 1.0:
            drive_v *= report.scale
        return replace(
            self._drive(drive_v), scale=report.scale, omitted_bound=report.omitted_bound, quiet=report.quiet_tracks
        )

    def write(self, path: Path, on_progress: OnProgress | None = None, *, force: bool = False) -> RenderReport:
        """Make all drives in a drive file, in constant memory. Raises InputError: as `collect` and `write_drive`."""
        sampled = self.sampled
        with drive_in_blocks(
            path, self.shape, sample_rate_hz=self._rate_hz, start_s=sampled.start_s, method=sampled.method,
            foci=sampled.foci, drive_unit=drive_unit(self._bank), focus_mm=sampled.focus_mm, force=force,
        ) as written:  # fmt: skip
            small = 8 * self.shape[0] * self.shape[1] <= MAX_WHOLE_BYTES
            report = self._prepared(on_progress, written.put, written.whole if small else None)
            written.finish(
                report.scale, scale=report.scale, omitted_bound=report.omitted_bound, quiet=report.quiet_tracks
            )
        return report

    def _prepared(
        self, on_progress: OnProgress | None, put: Put, whole: Callable[[], Float64Array] | None
    ) -> RenderReport:
        """Make all drives; `put` takes them without limits, and `whole` gives them back."""
        signals = [source.signal for source in self.sampled.sources]
        errors, remarks = judged_errors(self._scene, self._bank, self.sampled.interpolation, signals)
        between = self._made(on_progress, put)
        if self._bound() > self._tolerance:
            self._single = False
            self._accumulator = self._new_accumulator()
            between = self._made(on_progress, put)
        unit, unit_v = limited_unit(drive_unit(self._bank))
        levels = self._levels.against(self._limits, unit_v)
        limiting = strictest(levels)
        if self._interface is not None and between is not None:
            limiting = self._interface.strictest(levels, self._levels.peaks_v * unit_v, between * unit_v)
        self.report = report_render(
            self._scene, self._rows, self.sampled.sources, self._accumulator.statistics, self._levels.norms,
            limiting=replace(limiting, unit=unit), omitted_bound=self._bound(), errors=errors, remarks=remarks,
            quiet=None if self._quiet is None else self._quiet.figures(None if whole is None else self._drive(whole())),
        )  # fmt: skip
        return self.report

    def unlimited_blocks(self, ahead: int = 1) -> Iterator[Float64Array]:
        """Yield the drives without limits, in single precision where a tolerance is given.

        ahead: Most blocks whose rows are loaded together.
        """
        yield from self._accumulator.blocks(ahead)

    def _drive(self, drive_v: Float64Array) -> Drive:
        """The drive that was made, without limits and quiet places."""
        sampled = self.sampled
        return Drive(
            drive_v, self._rate_hz, sampled.start_s, sampled.method, 1.0, 0.0, *sampled.foci,
            drive_unit=drive_unit(self._bank), focus_mm=sampled.focus_mm,
        )  # fmt: skip

    def _new_accumulator(self) -> BlockAccumulator:
        return BlockAccumulator(self.sampled, self._rows, single=self._single, device=self._device)

    @np.errstate(over="ignore", invalid="ignore")
    def _made(self, on_progress: OnProgress | None, put: Put) -> Float64Array | None:
        """Make all drives, and find their levels; returns the largest magnitudes at the interface's rate."""
        actuators, samples = self.shape
        window = None if self._limits.rms_v is None else rms_window(samples, self._rate_hz)
        self._levels = RunningLevels(actuators, window)
        blocks = self._watched(on_progress, put)
        if self._rate is not None:
            return largest_of(self._rate.pieces(blocks, actuators, samples, 4096), actuators)
        for _ in blocks:
            pass
        return None

    def _watched(self, on_progress: OnProgress | None, put: Put) -> Iterator[Float64Array]:
        done, samples = 0, self.shape[1]
        for block in self.unlimited_blocks(BLOCKS_AHEAD):
            self._levels.add(block)
            if not self._single:  # where single precision overflows, all is made again
                require_finite(block)
            put(done, block)
            done += block.shape[1]
            yield block
            if on_progress is not None:
                on_progress(done, samples)

    def _bound(self) -> float:
        """Bound on the relative error of the drives made last."""
        return relative_bound(self._accumulator.error, float(np.linalg.norm(self._levels.norms)))


def render_with_report(
    scene: Scene, bank: GreenSource, on_progress: OnProgress | None = None, **options: Any
) -> tuple[Drive, RenderReport]:
    """Render a scene into the drives of all actuators, in memory; options as of `SceneRenderer`.

    on_progress: Called with samples done and samples in all.
    """
    renderer = SceneRenderer(scene, bank, **options)
    return renderer.collect(on_progress), renderer.report
