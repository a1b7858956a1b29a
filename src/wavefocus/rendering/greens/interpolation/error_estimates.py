"""Expected errors of an interpolation: from the correlation of neighbouring positions, or by leaving positions out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from wavefocus.calibration.numerics import transform_at
from wavefocus.calibration.wave_model import PatchKernel
from wavefocus.rendering.arrays import Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.base import GridInterpolation, Nodes
from wavefocus.rendering.greens.interpolation.error_bands import ErrorBands
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.greens.interpolation.row_values import RowValues
from wavefocus.rendering.greens.source import GreenSource, RowReader, usable

if TYPE_CHECKING:
    from wavefocus.rendering.greens.interpolation.kernel import KernelInterpolation


PAIRS = 4
BANDS_BELOW = 8
LOWEST_CORRELATION = -0.402
"""J0 at its first minimum, 3.83: shorter waves look like longer ones."""
SURE_CORRELATION = 0.45
"""Larger than J0 ever is beyond its first minimum, with room for chance."""
KERNEL_RADIANS = 4.4
"""Wave number times grid spacing up to which the regression over waves does better than interpolation of values."""
SERIES_RADIANS = 12.0
"""Up to here the power series of J0 is exact to 1e-11."""
SERIES_TERMS = 40


def j0(radians: Float64Array) -> Float64Array:
    """Bessel function J0, without 0.3 s of loading scipy.special where arguments are small, as mostly."""
    if radians.max(initial=0.0) > SERIES_RADIANS:
        from scipy import special

        return np.asarray(special.j0(radians))
    quarter, total = np.square(radians) / 4.0, np.ones_like(radians)
    for term in range(SERIES_TERMS, 0, -1):
        total = 1.0 - quarter / term**2 * total
    return total


RADIANS = np.linspace(0.0, 3.83, 512)
J0_TABLE = j0(RADIANS)


def expected_errors(
    bank: GreenSource, kind: GridInterpolation, points_mm: Float64Array, frequency_hz: Float64Array
) -> ErrorBands | None:
    """Estimate errors from a few pairs of neighbouring rows.

    Waves from all sides correlate like J0(k r) over a distance r. The correlation of neighbouring positions
    gives k at each frequency; an interpolation with weights w of positions x_n is then wrong at x by
    1 - 2 sum_n w_n J0(k |x - x_n|) + sum_nm w_n w_m J0(k |x_n - x_m|), as power.

    Returns None where the bank has no pair of neighbours at the points, (n, 2); frequencies ascend.
    """
    pairs, apart_mm = _pairs(bank, kind.grid, points_mm)
    if not len(pairs):
        return None
    # Lower frequencies, too: the wave number follows from them where neighbours hardly correlate any more.
    low_hz = max(bank.sample_rate_hz / bank.taps, 0.0 if bank.band_hz is None else bank.band_hz[0])
    below_hz = np.geomspace(low_hz, max(frequency_hz[0], low_hz), BANDS_BELOW, endpoint=False)
    below_hz = below_hz[below_hz < frequency_hz[0]]
    every_hz = np.concatenate([below_hz, frequency_hz])
    correlation, power = _correlation(bank, pairs, every_hz)
    asked = slice(len(below_hz), None)
    turned, power = _turned(every_hz, correlation)[asked], power[asked]
    wavenumber = turned / float(np.median(apart_mm))
    nodes = kind.nodes(points_mm)
    places = kind.grid.position_mm[nodes.rows]
    from_point = np.hypot(*(places - points_mm[:, None]).transpose(2, 0, 1))
    between = np.hypot(*(places[:, :, None] - places[:, None]).transpose(3, 0, 1, 2))
    k = wavenumber[:, None, None]
    wrong = 1.0 - 2.0 * (nodes.weights * j0(k * from_point)).sum(axis=2)
    wrong += np.einsum("pn,pm,bpnm->bp", nodes.weights, nodes.weights, j0(k[..., None] * between))
    errors = np.sqrt(np.maximum(wrong, 0.0))
    resolved = wavenumber * kind.grid.spacing_mm < KERNEL_RADIANS
    return ErrorBands(
        frequency_hz, np.median(errors, axis=1), errors.max(axis=1), power, np.where(resolved, 0.0, np.inf)
    )


def _turned(frequency_hz: Float64Array, correlation: Float64Array) -> Float64Array:
    """Wave number times distance of the neighbours, (bands,).

    J0 falls all the way to its first minimum, so that it can be looked up backwards. Beyond, it swings between
    -0.4 and 0.3: from the frequency on above which no correlation is larger, waves get shorter at least as fast
    as bending waves do, as the root of the frequency.
    """
    turned = np.interp(-np.maximum(correlation, LOWEST_CORRELATION), -J0_TABLE, RADIANS)
    large = np.flatnonzero(correlation > SURE_CORRELATION)
    for band in range(int(large[-1]) + 2 if len(large) else 1, len(turned)):
        grown = turned[band - 1] * np.sqrt(frequency_hz[band] / frequency_hz[band - 1])
        turned[band] = max(turned[band], grown)
    return np.asarray(turned)


def _pairs(bank: GreenSource, grid: PositionGrid, points_mm: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Rows near some of the points, each with a measured neighbour, (pairs, 2), and their distances."""
    position_mm, allowed = grid.position_mm, usable(bank)
    some = points_mm[:: max(len(points_mm) // PAIRS, 1)][:PAIRS]
    found, apart = [], []
    for first in grid.nearest(some)[0].tolist():
        gap_mm = position_mm - position_mm[first]
        square = np.einsum("pa,pa->p", gap_mm, gap_mm)
        square[~allowed | (square < (1e-3 * grid.spacing_mm) ** 2)] = np.inf
        second = int(np.argmin(square))
        if allowed[first] and square[second] <= (1.5 * grid.spacing_mm) ** 2:
            found.append((first, second))
            apart.append(float(np.sqrt(square[second])))
    return np.array(found, dtype=np.int64).reshape(-1, 2), np.array(apart)


def _correlation(bank: GreenSource, pairs: Int64Array, frequency_hz: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Correlation of the pairs' rows over actuators, and their power, (bands,) each."""
    product, power = np.zeros(len(frequency_hz)), np.zeros(len(frequency_hz))
    reader = RowReader(bank)
    rows = np.stack([reader.read(row) for row in pairs.ravel().tolist()])
    spectra = transform_at(rows, frequency_hz, bank.sample_rate_hz)
    for first, second in spectra.reshape(len(pairs), 2, bank.actuators, -1):
        norms = [np.square(np.abs(part)).sum(axis=0) for part in (first, second)]
        scale = np.sqrt(norms[0] * norms[1])
        product += np.divide((first.conj() * second).real.sum(axis=0), scale, out=np.zeros_like(scale), where=scale > 0)
        power += norms[0] / max(float(norms[0].max()), 1e-30)
    return product / len(pairs), power


UNRESOLVED = 0.3
"""Where the kernel misses more than this from a frequency on, in the median, its result is chance."""


def left_out_errors(
    kernel: KernelInterpolation, points_mm: Float64Array, nodes: Nodes | None = None, values: RowValues | None = None
) -> ErrorBands:
    """Estimate relative errors at points.

    Each point's nearest position is left out of its patch and predicted from the others, in closed form. What
    misses, over what the kernel expects to miss, gives the strength of the field in the kernel's terms; the
    kernel's variance at the point then gives the error there. It grows with the distance from the positions,
    which leaving out alone does not show: a left-out position is further from its neighbours than any point
    between them. Kinds other than the kernel's are wrong by their difference to it as well.

    `nodes` are those of another interpolation at the points, which is judged instead; `values` are rows at the
    frequencies that are judged, by default those of the kernel.
    """
    row_values = kernel.values if values is None else values
    anchors, _ = kernel.neighbourhoods.nearest(points_mm)
    frequency_hz = row_values.frequency_hz
    waves, bands = kernel.waves.at(frequency_hz), len(frequency_hz)
    unsure, found_energy, apart, taken_energy, strength = (np.zeros((bands, len(points_mm))) for _ in range(5))
    power = np.zeros(bands)
    kernels: dict[bytes, PatchKernel] = {}
    for anchor in np.unique(anchors).tolist():
        patch = kernel.neighbourhoods.patch(anchor)
        if patch.key not in kernels:
            kernels[patch.key] = PatchKernel(waves, patch.offset_mm)
        regression = kernels[patch.key]
        here = row_values.of(patch.rows)
        chosen = np.flatnonzero(anchors == anchor)
        offset_mm = points_mm[chosen] - kernel.neighbourhoods.position_of(anchor)
        missed = _energy(np.einsum("fn,fna->fa", regression.left_out, here))
        found = regression.weights(offset_mm) @ here
        unsure[:, chosen] = (missed / regression.left_out_variance)[:, None] * regression.variance(offset_mm)
        found_energy[:, chosen] = taken_energy[:, chosen] = _energy(found)
        strength[:, chosen] = _energy(here[:, 0])[:, None]
        if nodes is not None:
            weights = nodes.weights[chosen]
            rows = np.where(weights != 0, nodes.rows[chosen], anchor)
            other = row_values.of(rows.ravel()).reshape(bands, *rows.shape, -1)
            taken = np.einsum("pn,fpna->fpa", weights, other)
            apart[:, chosen] = _energy(taken - found)
            taken_energy[:, chosen] = _energy(taken)
        power += strength[:, chosen[0]]
    there = found_energy + unsure
    by_kernel, errors = _ratio(unsure, there), _ratio(unsure + apart, there)
    unresolved = _first_unresolved(np.median(by_kernel, axis=1))
    by_kernel[unresolved:] = _ratio(strength + found_energy, strength)[unresolved:]
    errors[unresolved:] = _ratio(strength + taken_energy, strength)[unresolved:]
    return ErrorBands(frequency_hz, np.median(errors, axis=1), errors.max(axis=1), power, np.median(by_kernel, axis=1))


def _ratio(wrong: Float64Array, there: Float64Array) -> Float64Array:
    return np.asarray(np.sqrt(np.divide(wrong, there, out=np.ones_like(wrong), where=there > 0)))


def _first_unresolved(by_kernel: Float64Array) -> int:
    """The first band from which on the positions are too far apart for the waves: the result is chance."""
    bad = (band for band in range(len(by_kernel)) if by_kernel[band] > UNRESOLVED)
    return next((band for band in bad if np.median(by_kernel[band:]) > UNRESOLVED), len(by_kernel))


def _energy(values: Complex128Array) -> Float64Array:
    """Energy over the actuators, the last axis."""
    return np.asarray(np.square(np.abs(values)).sum(axis=-1))
