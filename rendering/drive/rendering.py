"""Scenes into drives: eqs. (9) and (16) over a measured bank."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable

import numpy as np

from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.band import norm_of, relative_bound, row_norms, tolerance_of
from wavefocus.rendering.device import Device
from wavefocus.rendering.drive.accumulate import Accumulated, SourceDrives
from wavefocus.rendering.drive.coil_limits import DriveLimits, limit_drive, require_finite
from wavefocus.rendering.greens.interpolation.errors import judged_errors
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.greens.source import GreenSource, apply_exponent, drive_unit
from wavefocus.rendering.report.render_report import RenderReport, RenderWarning, report_render
from wavefocus.rendering.scene.model import Scene
from wavefocus.rendering.scene.sampling import Method, SampledScene, sample_scene
from wavefocus.storage.drive_file import Drive
from wavefocus.storage.errors import InputError

OnProgress = Callable[[int, int], None]

SOURCE_PARTS = 100
"""Steps of progress for each source."""


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
        scene, bank, method=method, tolerance_db=tolerance_db, interpolation_tolerance=interpolation_tolerance,
        on_progress=on_progress,
    )  # fmt: skip
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

    The drive starts at -(L - 1) samples of scene time, L the taps of the bank, even if all sources start later, and
    ends with the last emitted sample. A continuous emission lasts until n_M, silence included.

    method: Eq. (16) or eq. (9), see `sample_scene`.
    tolerance_db: Allows single precision as long as the proved bound on the relative L2 error of the drives stays below
        it, < 0. Without it all is computed in double precision, to 1e-12 of direct evaluation.
    interpolation_tolerance: Largest relative error of the Green's functions between the bank's positions, > 0: the
        median along the paths, in every band that the scene makes use of. Without it an error above 5 % is warned
        about.
    on_progress: Called with blocks done and blocks in all.
    device: Where to compute, by the array API; by default on this processor.

    Raises InputError: the scene does not fit the bank: a path off the grid, an unmeasured row on it, an empty signal, a
    drive that does not fit into float64, an interpolation beyond its tolerance.
    """
    tolerance = tolerance_of(tolerance_db)
    sampled = sample_scene(scene, bank, method)
    signals = [source.signal for source in sampled.sources]
    errors, remarks = judged_errors(scene, bank, sampled.kind, signals, interpolation_tolerance)
    rows = BankRows(sampled.kind.rows_of(bank), scene.regularisation)
    try:
        drive_v, accumulated, norms, bound = _accumulated(sampled, rows, tolerance, on_progress, device)
    except MemoryError as error:
        size = sampled.samples * bank.actuators * 8 / 2**30
        raise InputError(f"the drive takes {size:.3g} GiB, which do not fit into memory; shorten the scene") from error
    finite = bool(np.isfinite(norms).all())
    if not finite:
        require_finite(drive_v)
    limits = DriveLimits(scene.output.limit_v, scene.output.limit_rms_v)
    limiting = limit_drive(drive_v, float(bank.sample_rate_hz), limits)
    drive = Drive(
        drive_v, float(bank.sample_rate_hz), sampled.start_s, sampled.method, limiting.scale, bound, *sampled.foci,
        drive_unit=drive_unit(bank), known_finite=finite,
    )  # fmt: skip
    report = report_render(
        scene, rows, sampled.sources, accumulated, norms,
        limiting=limiting, omitted_bound=bound, errors=errors, remarks=remarks,
    )  # fmt: skip
    return drive, report


def _accumulated(
    scene: SampledScene, rows: BankRows, tolerance: float, on_progress: OnProgress | None, device: Device | None
) -> tuple[Float64Array, list[Accumulated], Float64Array, float]:
    """Drives, what each source cost, norms of the drives, and the bound on what was left out."""
    for single in (True, False) if tolerance > 0 else (False,):
        drive_v = np.zeros((rows.bank.actuators, scene.samples))
        accumulated: list[Accumulated] = []

        with np.errstate(over="ignore", invalid="ignore"):
            for source in scene.sources:
                rows.needed_by = source.naming
                made = SourceDrives(
                    source, rows, single=single, on_block=_counted(on_progress, source.index, scene),
                    device=device,
                )  # fmt: skip
                accumulated.append(made.add_to(drive_v))
        norms = row_norms(drive_v)
        bound = relative_bound(math.fsum(item.error for item in accumulated), norm_of(norms))
        if bound <= tolerance:
            break
    drive_v = apply_exponent(drive_v, rows.drive_exponent)
    norms = row_norms(drive_v)
    return drive_v, accumulated, norms, bound


def _counted(on_progress: OnProgress | None, source: int, scene: SampledScene) -> OnProgress | None:
    """Progress of one source as a part of the whole."""
    if on_progress is None:
        return None
    return lambda done, total: on_progress(
        source * SOURCE_PARTS + SOURCE_PARTS * done // total, len(scene.sources) * SOURCE_PARTS
    )
