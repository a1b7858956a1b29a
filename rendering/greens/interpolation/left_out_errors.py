"""The error of an interpolation, estimated by leaving positions out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calibration.neighbours.wave_model import PatchKernel
from rendering.greens.fourier import transform_at
from rendering.greens.interpolation.base import Nodes
from rendering.greens.interpolation.correlation_errors import ErrorBands
from rendering.greens.source import GreenSource, read_row
from storage.errors import InputError

if TYPE_CHECKING:
    from rendering.greens.interpolation.kernel import KernelInterpolation

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]
Int64Array = NDArray[np.int64]


class RowValues:
    """Fourier transforms of a bank's rows at frequencies (n,), each row read once.

    Values are the bank's over one power of two, the same for all rows, so that a bank in any unit fits.
    """

    def __init__(self, bank: GreenSource, frequency_hz: Float64Array) -> None:
        self._bank = bank
        self.frequency_hz = frequency_hz
        self._cached: dict[int, Complex128Array] = {}
        self._exponent: int | None = None

    def of(self, rows: Int64Array) -> Complex128Array:
        """Values of rows, (frequencies, rows, actuators).

        Raises InputError where a row is all zeros, or holds NaN or infinity.
        """
        for row in rows.tolist():
            if row not in self._cached:
                self._cached[row] = self._read(row)
        return np.stack([self._cached[row] for row in rows.tolist()], axis=1)

    def _read(self, row: int) -> Complex128Array:
        scaled = read_row(self._bank, row)
        if scaled.silent:
            x, y = np.asarray(self._bank.position_mm)[row]
            raise InputError(
                f"position {row} at ({x:.6g}, {y:.6g}) mm is all zeros, so not measured, but interpolation"
                " needs it; remeasure or disable the position"
            )
        if self._exponent is None:
            self._exponent = scaled.exponent
        values = np.ldexp(scaled.values, scaled.exponent - self._exponent)
        return np.ascontiguousarray(transform_at(values, self.frequency_hz, self._bank.sample_rate_hz).T)


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
