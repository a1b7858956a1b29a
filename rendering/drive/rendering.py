"""Scenes into drives: eqs. (9) and (16) over a measured bank."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.blas import one_blas_thread
from rendering.band import norm_of, relative_bound, row_norms, tolerance_of
from rendering.device import Device
from rendering.drive.accumulate import Accumulated, SourceDrives
from rendering.drive.coil_limits import DriveLimits, limit_drive, require_finite
from rendering.greens.bank_rows import BankRows
from rendering.greens.interpolation.errors import interpolation_errors, judge_interpolation
from rendering.greens.source import GreenSource, drive_unit
from rendering.report.render_report import RenderReport, RenderWarning, report_render
from rendering.scene.model import Scene
from rendering.scene.sampling import Method, SampledSource, sample_scene
from storage.drive_file import Drive
from storage.errors import InputError

Float64Array = NDArray[np.float64]
OnProgress = Callable[[int, int], None]

STRICTER = (1.0, 0.6, 0.2, 0.0)
"""Shares of the tolerance tried one after another until the proved bound holds; 0 computes everything."""


def render(
    scene: Scene,
    bank: GreenSource,
    *,
    method: Method | None = None,
    tolerance_db: float | None = None,
    interpolation_tolerance: float | None = None,
    on_progress: OnProgress | None = None,
) -> Drive:
    """Render a scene; warnings are issued as `RenderWarning`. See `render_with_report`."""
    drive, report = render_with_report(
        scene,
        bank,
        method=method,
        tolerance_db=tolerance_db,
        interpolation_tolerance=interpolation_tolerance,
        on_progress=on_progress,
    )
    for text in report.warnings:
        warnings.warn(text, RenderWarning, stacklevel=2)
    return drive


def render_with_report(
    scene: Scene,
    bank: GreenSource,
    *,
    method: Method | None = None,
    tolerance_db: float | None = None,
    interpolation_tolerance: float | None = None,
    on_progress: OnProgress | None = None,
    device: Device | None = None,
) -> tuple[Drive, RenderReport]:
    """Render a scene into the drives of all actuators.

    The drive starts at -(L - 1) samples of scene time, L the taps of the bank, even if all sources start
    later, and ends with the last emitted sample. A continuous emission lasts until n_M, silence included.

    scene: Sources, regularisation, interpolation and limit.
    method, {"sampled", "exact"}: Eq. (16) or eq. (9). By default exact, but sampled where every source emits per point,
        for which the two are the same.
    tolerance_db: Allows leaving out frequency bins as long as the proved bound on the relative L2 error of the drives
        stays below it, < 0. Without it all is computed, to 1e-12 of direct evaluation.
    interpolation_tolerance: Largest relative error of the Green's functions between the bank's positions, > 0: the
        median along the paths, in every band that the scene makes use of. Without it an error above 5 % is warned
        about.
    on_progress: Called with blocks done and blocks in all.
    device: Where to compute, by the array API; by default on this processor.

    Returns Drive: volts, with the foci source by source; RenderReport: warnings and figures. Raises InputError: the
    scene does not fit the bank: a path off the grid, an unmeasured row on it, an empty signal, a drive that does not
    fit into float64, an interpolation beyond its tolerance.
    """
    chosen = chosen_method(scene, method)
    tolerance = tolerance_of(tolerance_db)
    kind, sources = sample_scene(scene, bank, chosen)
    signals = [source.signal for source in sources]

    with one_blas_thread():
        errors = interpolation_errors(scene, bank, kind, signals, thorough=interpolation_tolerance is not None)
    remarks = judge_interpolation(errors, interpolation_tolerance)
    rows = BankRows(kind.rows_of(bank), scene.regularisation)
    samples = max(source.emission.stop_sample for source in sources) + bank.taps - 1
    try:
        drive_v, accumulated, norms, bound = _accumulated(sources, rows, samples, tolerance, on_progress, device)
    except MemoryError as error:
        size = samples * bank.actuators * 8 / 2**30
        raise InputError(f"the drive takes {size:.3g} GiB, which do not fit into memory; shorten the scene") from error
    finite = bool(np.isfinite(norms).all())
    if not finite:
        require_finite(drive_v)
    limits = DriveLimits(scene.output.limit_v, scene.output.limit_rms_v)
    limiting = limit_drive(drive_v, float(bank.sample_rate_hz), limits)
    drive = Drive(
        drive_v=drive_v,
        sample_rate_hz=float(bank.sample_rate_hz),
        start_s=-(bank.taps - 1) / bank.sample_rate_hz,
        method=chosen,
        scale=limiting.scale,
        omitted_bound=bound,
        focus_sample=np.concatenate([source.focus_sample for source in sources]),
        focus_position=np.concatenate([source.focus_position for source in sources]),
        focus_source=np.concatenate(
            [np.full(len(source.focus_sample), source.index, dtype=np.int64) for source in sources]
        ),
        drive_unit=drive_unit(bank),
        known_finite=finite,
    )
    report = report_render(
        scene, rows, sources, accumulated, norms, limiting=limiting, omitted_bound=bound, errors=errors, remarks=remarks
    )
    return drive, report


def chosen_method(scene: Scene, method: str | None) -> Method:
    """The method asked for, or the default: sampled where all emission is per point, else exact.

    Raises InputError: there is no such method.
    """
    if method not in (None, "sampled", "exact"):
        raise InputError(f"method is {method!r}; allowed are 'sampled' and 'exact'")
    if method is None:
        per_point = all(source.emission == "per_point" for source in scene.sources)
        return "sampled" if per_point else "exact"
    return "sampled" if method == "sampled" else "exact"


def _accumulated(
    sources: Sequence[SampledSource],
    rows: BankRows,
    samples: int,
    tolerance: float,
    on_progress: OnProgress | None,
    device: Device | None,
) -> tuple[Float64Array, list[Accumulated], Float64Array, float]:
    for share in STRICTER if tolerance > 0 else (0.0,):
        drive_v = np.zeros((rows.bank.actuators, samples))
        progress = _Progress(sources, on_progress)
        accumulated: list[Accumulated] = []
        with np.errstate(over="ignore", invalid="ignore"):
            for source in sources:
                rows.needed_by = source.naming
                made = SourceDrives(
                    source.emission,
                    rows,
                    fft_samples=source.fft_samples(rows.bank.taps, rows.bank.actuators),
                    tolerance=share * tolerance,
                    band_hz=rows.bank.band_hz,
                    on_block=progress.of(source),
                    device=device,
                )
                accumulated.append(made.add_to(drive_v))
        norms = row_norms(drive_v)
        bound = relative_bound(math.fsum(item.error for item in accumulated), norm_of(norms))
        if bound <= tolerance:
            break
    if rows.drive_exponent:
        with np.errstate(over="ignore", under="ignore"):
            np.ldexp(drive_v, rows.drive_exponent, out=drive_v)
        norms = row_norms(drive_v)
    return drive_v, accumulated, norms, bound


class _Progress:
    """Joins the sources' blocks into one count."""

    def __init__(self, sources: Sequence[SampledSource], on_progress: OnProgress | None) -> None:
        self._sources = sources
        self._on_progress = on_progress

    def of(self, source: SampledSource) -> OnProgress | None:
        on_progress = self._on_progress
        if on_progress is None:
            return None
        parts = 100

        def report(done: int, total: int) -> None:
            on_progress(source.index * parts + parts * done // total, len(self._sources) * parts)

        return report
