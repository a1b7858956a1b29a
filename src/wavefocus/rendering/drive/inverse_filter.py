"""Focusing by regularised inverse filtering, to be compared with time reversal on the same scene.

At each frequency the transfer functions H from N actuators to M control points are inverted (Tikhonov):

    F = H* (H H* + lambda I)^-1 D,

D being the response wanted at each control point: its own emissions, and nothing of the other points'. Tanter, Thomas
& Fink, "Time reversal and the inverse filter" (2000), call it the spatio-temporal inverse filter; for one point
it is time reversal with the spectrum made flat.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from wavefocus.config.scene import Regularisation
from wavefocus.rendering.arrays import Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.device import fast_length
from wavefocus.rendering.drive.coil_limits import (
    DriveLimits,
    Limiting,
    levels_of,
    relative_rms,
    require_finite,
    strictest,
)
from wavefocus.rendering.drive.wav import Interface
from wavefocus.rendering.field.metrics import band_weights
from wavefocus.rendering.greens.interpolation.base import Nodes
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.greens.source import GreenSource, apply_exponent, drive_unit
from wavefocus.rendering.scene.model import Scene
from wavefocus.rendering.scene.sampling import SampledSource, sample_scene
from wavefocus.storage.drive_file import Drive
from wavefocus.storage.errors import InputError

REGULARISATION_DB = -20.0
ILL_CONDITIONED = 1e3
"""Condition from which the control points are said not to be independent."""
SAME_MM = 1e-6
SYSTEM_BYTES = 2**30


@dataclass(frozen=True, slots=True)
class InverseReport:
    """Figures of one inverse filter.

    control_points: Different places among the path points.
    regularisation_db: lambda over the largest power, at any frequency, that the actuators bring to a control point on
        average.
    frequency_hz, float64 (bins,): Frequencies that were inverted.
    condition, float64 (bins,): Largest over smallest singular value of H; infinite where H has not full rank.
    regularised_condition, float64 (bins,): The same of ``[H; sqrt(lambda) I]``, which is what was solved.
    misfit: Relative L2 error of the response at the control points against the response wanted, over the band.
    cut_share: Share of the drive's energy that lay before the lead-in or after the last emitted sample, and was cut.
    """

    warnings: tuple[str, ...]
    control_points: int
    regularisation_db: float
    frequency_hz: Float64Array
    condition: Float64Array
    regularised_condition: Float64Array
    misfit: float
    cut_share: float
    limiting: Limiting
    relative_rms_drive: Float64Array

    @property
    def scale(self) -> float:
        """What the limits did to the drive, 1 if nothing."""
        return self.limiting.scale

    @property
    def worst_condition(self) -> tuple[float, float]:
        """Frequency at which H is conditioned worst, and its condition there."""
        worst = int(np.argmax(self.condition))
        return float(self.frequency_hz[worst]), float(self.condition[worst])


def inverse_filter(
    scene: Scene,
    bank: GreenSource,
    *,
    regularisation_db: float = REGULARISATION_DB,
    interface: Interface | None = None,
) -> tuple[Drive, InverseReport]:
    """Make the drives of a scene by inverse filtering at its path points.

    The drive has the place in time that time reversal's has. A continuous emission is handed from path point
    to path point, as in eq. (12). Where the scene normalises, an impulse of amplitude A makes a response A at
    its control point and focus instant, as far as no other point's emission meets it; else the response is the
    source's signal, limited to the bank's band.

    scene: Sources; their interpolation and limit. Saturation belongs to time reversal and is not applied.
    regularisation_db: lambda over the largest mean power at a control point, in dB, < 0.
    interface: As of `wavefocus.rendering.drive.rendering.SceneRenderer`.

    Raises InputError: the scene does not fit the bank, or there are too many control points.
    """
    if not (math.isfinite(regularisation_db) and regularisation_db < 0):
        raise InputError(f"regularisation_db is {regularisation_db}; it must be a finite number below 0")
    rate_hz, taps = float(bank.sample_rate_hz), bank.taps
    sampled = sample_scene(scene, bank, "sampled")
    interpolation, sources, samples = sampled.interpolation, sampled.sources, sampled.samples
    nodes = [
        interpolation.follow(source.path, sampled_source.arc_length_mm)(sampled_source.arc_length_mm)
        for source, sampled_source in zip(scene.sources, sources, strict=True)
    ]
    rows = BankRows(interpolation.rows_of(bank), Regularisation(normalise=False))
    length = fast_length(samples + 3 * taps)
    band = _Band(length, rate_hz, bank.band_hz)
    points_mm, place = _control_points(sources)
    if 16 * len(band.bins) * len(points_mm) * bank.actuators > SYSTEM_BYTES:
        raise InputError(
            f"{len(points_mm)} control points over {samples / rate_hz:.3g} s are too many to invert; use a coarser"
            " step_mm or a shorter scene"
        )
    system = _system(rows, nodes, place, len(points_mm), band, length)
    largest = float(np.square(np.abs(system)).sum(axis=2).mean(axis=1).max())
    ridge = largest * 10.0 ** (regularisation_db / 10.0)
    singular = np.linalg.svd(system, compute_uv=False)
    inverse = _inverse(system, ridge)
    gain = _gains(system, inverse, band) if scene.regularisation.normalise else np.ones(len(points_mm))
    per_point = [source.emission == "per_point" for source in scene.sources]
    wanted = gain * _wanted(sources, per_point, place, len(points_mm), band, length, lead=2 * taps - 1)
    spectra = np.einsum("bnm,bm->bn", inverse, wanted)
    reached = np.einsum("bmn,bn->bm", system, spectra)
    misfit = float(np.linalg.norm(reached - wanted) / max(float(np.linalg.norm(wanted)), 1e-300))
    whole = np.zeros((bank.actuators, length // 2 + 1), dtype=np.complex128)
    whole[:, band.bins] = spectra.T
    in_time = np.fft.irfft(whole, length, axis=1)
    drive_v = np.ascontiguousarray(in_time[:, taps : taps + samples])
    energy = float(np.square(in_time).sum())
    cut_share = 1.0 - float(np.square(drive_v).sum()) / energy if energy > 0 else 0.0
    # Without normalisation in `rows`, their exponent is the bank's; an inverse is over it.
    drive_v = apply_exponent(drive_v, -rows.drive_exponent)
    require_finite(drive_v)
    limits = DriveLimits(scene.output.limit_v, scene.output.limit_rms_v)
    levels = levels_of(drive_v, rate_hz, limits=limits)
    reached = levels.against(limits)
    if interface is None:
        limiting = strictest(reached)
    else:
        limiting = interface.strictest(reached, levels.peaks_v, interface.between_v(drive_v, rate_hz))
    drive_v *= limiting.scale
    drive = Drive(
        drive_v, rate_hz, sampled.start_s, "inverse-filter", limiting.scale, 0.0, *sampled.foci,
        drive_unit=drive_unit(bank), focus_mm=sampled.focus_mm,
    )  # fmt: skip
    smallest = singular[:, -1]
    condition = np.divide(singular[:, 0], smallest, out=np.full_like(smallest, np.inf), where=smallest > 0)
    report = InverseReport(
        warnings=(),
        control_points=len(points_mm),
        regularisation_db=regularisation_db,
        frequency_hz=band.frequency_hz,
        condition=condition,
        regularised_condition=np.sqrt((np.square(singular[:, 0]) + ridge) / (np.square(smallest) + ridge)),
        misfit=misfit,
        cut_share=cut_share,
        limiting=limiting,
        relative_rms_drive=relative_rms(drive_v),
    )
    return drive, _with_warnings(report, scene)


class _Band:
    """The bins of a transform within the bank's band, and how they fade at its ends."""

    def __init__(self, length: int, rate_hz: float, band_hz: tuple[float, float] | None) -> None:
        weights = np.ones(length // 2 + 1) if band_hz is None else band_weights(length, rate_hz, band_hz)
        self.bins: Int64Array = np.flatnonzero(weights > 0)
        self.frequency_hz: Float64Array = np.fft.rfftfreq(length, 1.0 / rate_hz)[self.bins].astype(np.float64)
        self.weights: Float64Array = weights[self.bins].astype(np.float64)
        # What a bin adds to the first sample of a real signal: all but the first and last count twice.
        ends = (self.bins == 0) | (2 * self.bins == length)
        self.share: Float64Array = self.weights * np.where(ends, 1.0, 2.0) / length


def _control_points(sources: Sequence[SampledSource]) -> tuple[Float64Array, list[Int64Array]]:
    """Different places among the path points, and which of them each point of each source is."""
    points_mm = np.concatenate([source.points_mm for source in sources])
    _, first, place = np.unique(np.rint(points_mm / SAME_MM), axis=0, return_index=True, return_inverse=True)
    edges = np.cumsum([len(source.points_mm) for source in sources])[:-1]
    return points_mm[first], [part.astype(np.int64) for part in np.split(place.ravel(), edges)]


def _system(
    rows: BankRows, nodes: Sequence[Nodes], place: Sequence[Int64Array], points: int, band: _Band, length: int
) -> Complex128Array:
    """Transfer functions (bins, points, actuators), of rows as `rows` reads them."""
    uses: dict[int, dict[int, float]] = {}
    for source_nodes, at in zip(nodes, place, strict=True):
        for point, own_rows, weights in zip(
            at.tolist(), source_nodes.rows.tolist(), source_nodes.weights.tolist(), strict=True
        ):
            for row, weight in zip(own_rows, weights, strict=True):
                if weight:
                    uses.setdefault(row, {})[point] = weight
    system = np.zeros((len(band.bins), points, rows.bank.actuators), dtype=np.complex128)
    for row, by_point in sorted(uses.items()):
        spectrum = np.fft.rfft(rows.read(row), length, axis=1)[:, band.bins].T
        for point, weight in by_point.items():
            system[:, point] += weight * spectrum
    return system


def _wanted(
    sources: Sequence[SampledSource],
    per_point: Sequence[bool],
    place: Sequence[Int64Array],
    points: int,
    band: _Band,
    length: int,
    *,
    lead: int,
) -> Complex128Array:
    """Spectra of the response wanted at the control points, (bins, points)."""
    wanted = np.zeros((points, length))
    for source, anew, at in zip(sources, per_point, place, strict=True):
        begins, first = source.focus_sample, source.emission.first_sample
        ends = np.append(begins[1:], source.emission.stop_sample)
        for point, begin, end in zip(at.tolist(), begins.tolist(), ends.tolist(), strict=True):
            part = source.signal if anew else source.signal[begin - first : end - first]
            wanted[point, lead + begin : lead + begin + len(part)] += part
    spectra = np.fft.rfft(wanted, axis=1)[:, band.bins].T
    return np.asarray(spectra * band.weights[:, None])


def _inverse(system: Complex128Array, ridge: float) -> Complex128Array:
    """H* (H H* + ridge)^-1, (bins, actuators, points), by whichever of the two normal equations is smaller."""
    adjoint = system.conj().transpose(0, 2, 1)
    points, actuators = system.shape[1:]
    if points <= actuators:
        normal = system @ adjoint + ridge * np.eye(points)
        # The normal matrix is Hermitian, so that (normal^-1 H)* is what is wanted.
        return np.asarray(np.linalg.solve(normal, system).conj().transpose(0, 2, 1))
    return np.asarray(np.linalg.solve(adjoint @ system + ridge * np.eye(actuators), adjoint))


def _gains(system: Complex128Array, inverse: Complex128Array, band: _Band) -> Float64Array:
    """What makes each point's response to its own impulse 1 at its first sample, (points,)."""
    reached = np.einsum("bmn,bnm->bm", system, inverse).real
    return np.asarray(1.0 / np.maximum(band.share @ reached, 1e-300))


def _with_warnings(report: InverseReport, scene: Scene) -> InverseReport:
    warnings = []
    frequency_hz, condition = report.worst_condition
    if condition > ILL_CONDITIONED:
        held = float(report.regularised_condition.max())
        warnings.append(
            f"the {report.control_points} control points are hardly independent: condition {condition:.2g} at"
            f" {frequency_hz:.3g} Hz, held to {held:.2g} by a regularisation of {report.regularisation_db:g} dB"
        )
    if scene.regularisation.saturation or scene.regularisation.saturation_absolute:
        warnings.append("saturation belongs to time reversal; inverse filtering was done without it")
    if report.misfit > 0.5:
        warnings.append(
            f"the response at the control points differs from the one wanted: {100 * report.misfit:.0f} % off; fewer or"
            " more distant points, a lower speed or less regularisation would help"
        )
    return replace(report, warnings=tuple(warnings))
