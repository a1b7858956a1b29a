"""The error of an interpolation, estimated by leaving positions out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rendering.interpolation import Nodes
from rendering.kernel.interpolation import KernelInterpolation
from rendering.kernel.wave_model import PatchKernel

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]


def left_out_errors(
    kernel: KernelInterpolation, points_mm: Float64Array, nodes: Nodes | None = None
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Estimate relative errors at points.

    Each point's nearest position is left out of its patch and predicted from the others, in closed form. What
    that misses, over what the kernel expects to miss, tells how strong the field is in the kernel's terms; the
    kernel's variance at the point then gives the error there. It grows with the distance from the positions,
    which leaving out alone does not show: a left-out position is further from its neighbours than any point
    between them. Kinds other than the kernel's are wrong by their difference to it as well.

    Parameters
    ----------
    kernel : KernelInterpolation
        The regression.
    points_mm : float64 array, shape (points, 2)
        Where.
    nodes : Nodes, optional
        Rows and weights of another interpolation at the points, which is judged instead.

    Returns
    -------
    frequency_hz, median, worst, power : float64 arrays, shape (bands,)
        Centres of bands, median and worst error over the points, mean power of the rows.
    """
    anchors, _ = kernel.neighbourhoods.nearest(points_mm)
    frequency_hz = kernel.values.frequency_hz
    waves, bands = kernel.waves.at(frequency_hz), len(frequency_hz)
    errors = np.empty((bands, len(points_mm)))
    power = np.zeros(bands)
    kernels: dict[bytes, PatchKernel] = {}
    for anchor in np.unique(anchors).tolist():
        patch = kernel.neighbourhoods.patch(anchor)
        if patch.key not in kernels:
            kernels[patch.key] = PatchKernel(waves, patch.offset_mm)
        regression = kernels[patch.key]
        values = kernel.values.of(patch.rows)
        chosen = np.flatnonzero(anchors == anchor)
        offset_mm = points_mm[chosen] - kernel.neighbourhoods.position_of(anchor)
        missed = _energy(np.einsum("fn,fna->fa", regression.left_out, values))
        strength = missed / regression.left_out_variance
        found = regression.weights(offset_mm) @ values
        wrong = strength[:, None] * regression.variance(offset_mm)
        if nodes is not None:
            weights = nodes.weights[chosen]
            rows = np.where(weights != 0, nodes.rows[chosen], anchor)
            other = kernel.values.of(rows.ravel()).reshape(bands, *rows.shape, -1)
            wrong = wrong + _energy(np.einsum("pn,fpna->fpa", weights, other) - found)
        there = _energy(found)
        errors[:, chosen] = np.sqrt(np.divide(wrong, there, out=np.ones_like(wrong), where=there > 0))
        power += _energy(values[:, 0])
    return frequency_hz, np.median(errors, axis=1), errors.max(axis=1), power


def _energy(values: Complex128Array) -> Float64Array:
    """Energy over the actuators, the last axis."""
    return np.asarray(np.square(np.abs(values)).sum(axis=-1))
