"""Errors of an interpolation by leaving positions out of the kernel's patches."""

from typing import Any

import numpy as np

from wavefocus.calibration.evidence import MOST
from wavefocus.calibration.numerics import transform_at
from wavefocus.calibration.wave_model import PatchKernel
from wavefocus.rendering.arrays import Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.base import Estimate, Interpolation
from wavefocus.rendering.greens.source import GreenSource, RowReader
from wavefocus.storage.errors import InputError

NO_BOUND = "no bound: positions that are left out of a grid say nothing for sure of places between its positions"


class RowValues:
    """Fourier transforms of a bank's rows at frequencies (n,), each row read once."""

    def __init__(self, bank: GreenSource, frequency_hz: Float64Array) -> None:
        self._bank = bank
        self.frequency_hz = frequency_hz
        self._cached: dict[int, Complex128Array] = {}
        self._reader = RowReader(bank)
        self.actuators = bank.actuators

    def of(self, rows: Int64Array) -> Complex128Array:
        """Values of rows, (frequencies, rows, actuators).

        Raises InputError where a row is all zeros, or holds NaN or infinity.
        """
        for row in rows.tolist():
            if row not in self._cached:
                self._cached[row] = self._read(row)
        return np.stack([self._cached[row] for row in rows.tolist()], axis=1)

    def _read(self, row: int) -> Complex128Array:
        green = self._reader.read(row)
        if not green.any():
            x, y = np.asarray(self._bank.position_mm)[row]
            raise InputError(
                f"position {row} at ({x:.6g}, {y:.6g}) mm is all zeros, so not measured, but interpolation"
                " needs it; remeasure or disable the position"
            )
        return np.ascontiguousarray(transform_at(green, self.frequency_hz, self._bank.sample_rate_hz).T)


def left_out_estimate(
    kernel: Any, points_mm: Float64Array, values: RowValues, other: Interpolation | None = None
) -> Estimate:
    """Values of the kernel, or of another interpolation, at points (n, 2), and their errors.

    Each point's nearest position is left out of its patch and predicted from the others, in closed form. What
    misses, over what the kernel expects to miss, gives the strength of the field in the kernel's terms; the
    kernel's variance at the point then gives the error there. It grows with the distance from the positions,
    which leaving out alone does not show: a left-out position is further from its neighbours than any point
    between them. Another interpolation is wrong by its difference to the kernel as well.

    kernel: A `KernelInterpolation`, whose module imports this one.
    values: Rows at the frequencies that are judged.
    """
    anchors, _ = kernel.neighbourhoods.nearest(points_mm)
    frequency_hz = values.frequency_hz
    nodes = None if other is None else other.nodes(points_mm)
    waves, shape = kernel.waves.at(frequency_hz), (len(frequency_hz), len(points_mm), values.actuators)
    unsure, apart, strength, by_kernel = (np.zeros(shape) for _ in range(4))
    taken = np.zeros(shape, dtype=np.complex128)
    kernels: dict[bytes, PatchKernel] = {}
    for anchor in np.unique(anchors).tolist():
        patch = kernel.neighbourhoods.patch(anchor)
        if patch.key not in kernels:
            kernels[patch.key] = PatchKernel(waves, patch.offset_mm)
        regression, here = kernels[patch.key], values.of(patch.rows)
        chosen = np.flatnonzero(anchors == anchor)
        offset_mm = points_mm[chosen] - kernel.neighbourhoods.position_of(anchor)
        missed = _square(np.einsum("fn,fna->fa", regression.left_out, here)) / regression.left_out_variance[:, None]
        found = regression.weights(offset_mm) @ here
        unsure[:, chosen] = missed[:, None] * regression.variance(offset_mm)[:, :, None]
        taken[:, chosen], strength[:, chosen], by_kernel[:, chosen] = found, _square(here[:, :1]), _square(found)
        if nodes is not None:
            weights = nodes.weights[chosen]
            rows = np.where(weights != 0, nodes.rows[chosen], anchor)
            of_rows = values.of(rows.ravel()).reshape(len(frequency_hz), *rows.shape, -1)
            taken[:, chosen] = np.einsum("pn,fpna->fpa", weights, of_rows)
            apart[:, chosen] = _square(taken[:, chosen] - found)
    wrong, there = unsure + apart, (by_kernel + unsure).sum(axis=2)
    share = np.divide(unsure.sum(axis=2), there, out=np.ones_like(there), where=there > 0)
    unresolved = _first_unresolved(np.median(np.sqrt(share), axis=1))
    wrong[unresolved:], there[unresolved:] = (strength + _square(taken))[unresolved:], strength[unresolved:].sum(axis=2)
    return Estimate(
        taken, np.sqrt(wrong), np.full(shape, np.nan), np.sqrt(there), "left-out positions",
        NO_BOUND,
    )  # fmt: skip


def _first_unresolved(by_kernel: Float64Array) -> int:
    """The first band from which on the positions are too far apart for the waves: the result is chance."""
    bad = (band for band in range(len(by_kernel)) if by_kernel[band] > MOST)
    return next((band for band in bad if np.median(by_kernel[band:]) > MOST), len(by_kernel))


def _square(values: Complex128Array) -> Float64Array:
    return np.asarray(np.square(values.real) + np.square(values.imag))
