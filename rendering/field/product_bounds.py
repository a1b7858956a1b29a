"""What errs in products of drives' spectra with rows' spectra, from a few sizes of either.

A block's response has the spectrum F = sum_i U_i G_i over the actuators i. With U and G for the norms over all
actuators, bin by bin, |F| <= U G (Cauchy-Schwarz), and so over bins that are left out

    |F|_2 <= |U|_2 * max G                                       (Hoelder)

with norm and largest value over these bins: that way round, because a drive's spectrum is as rough as the
source's and a Green's function's is smooth, so that the norm is close to what the largest value would make.
In single precision the drives' transforms err by a vector of norm at most e |U|_2, which meets at most the
largest G, and a row's by one of at most e |G|_2, which meets at most the largest U. Either error falls into
bins computed or into those whose size it falsifies, so counts once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendering.drive.omission import SQUARES_LOST, TRANSFORM, Economy

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

CUT_UNITS = 4.0
"""Units of roundoff by which samples of a block err before their transform: rounded, and faded."""


@dataclass(frozen=True, slots=True)
class SpectrumSizes:
    """Sizes of some spectra over all actuators: in the segments of an economy, then over all bins.

    Parameters
    ----------
    norms : float64 array, shape (spectra, segments + 1)
        Euclidean norms, no smaller than rounding.
    largest : float64 array, shape (spectra, segments + 1)
        Largest norms of any bin, likewise.
    """

    norms: Float64Array
    largest: Float64Array

    @classmethod
    def zeros(cls, count: int, economy: Economy) -> SpectrumSizes:
        """Of silence."""
        return cls(np.zeros((count, economy.segments + 1)), np.zeros((count, economy.segments + 1)))

    @classmethod
    def of(cls, squared: NDArray[Any], economy: Economy, actuators: int) -> SpectrumSizes:
        """Of spectra whose squares, added up over the actuators, these are, (spectra, bins)."""
        square = np.empty((len(squared), economy.segments + 1))
        square[:, :-1] = np.add.reduceat(squared, economy.starts, axis=1)
        square[:, -1] = square[:, :-1].sum(axis=1)
        norms, largest = np.sqrt(square), economy.largest(squared)
        if economy.single:
            # A sum of so many terms loses at most a unit with each, and what vanishes.
            slack = 1.0 + (economy.bins + actuators + 20.0) * economy.roundoff
            lost = np.sqrt(float(actuators)) * SQUARES_LOST
            norms, largest = norms * slack + np.sqrt(economy.bins) * lost, largest * slack + lost
        return cls(norms, largest)

    def some(self, places: slice | Int64Array) -> SpectrumSizes:
        """Of some of the spectra."""
        return SpectrumSizes(self.norms[places], self.largest[places])


def joint_squares(spectra: NDArray[Any]) -> NDArray[Any]:
    """Squares of the norms over the actuators, bin by bin: (..., actuators, bins) to (..., bins)."""
    parts = spectra.view(spectra.real.dtype)
    squares = np.einsum("...ak,...ak->...k", parts, parts)
    summed: NDArray[Any] = squares[..., ::2] + squares[..., 1::2]
    return summed


def drive_units(fft_samples: int, economy: Economy) -> float:
    """Bound on the error of drives' transforms in single precision, relative to the norms of half their spectra."""
    # The theorem is of whole spectra, whose norm is at most sqrt(2) times that of the half.
    return float((TRANSFORM * np.log2(fft_samples) + CUT_UNITS) * np.sqrt(2.0) * economy.roundoff)


def product_errors(
    economy: Economy,
    fft_samples: int,
    actuators: int,
    rows: SpectrumSizes,
    blocks: SpectrumSizes,
    units: float = 0.0,
) -> Float64Array:
    """Bounds on the norms of errors of blocks in time: of what is left out, and of its rounding, (rows, blocks).

    Parameters
    ----------
    economy : Economy
        Which bins are computed, and in which precision.
    fft_samples : int
        Transform length.
    actuators : int
        Over how many is summed.
    rows, blocks : SpectrumSizes
        Of the rows' spectra and of the drives'.
    units : float
        Relative error of the drives' transforms, `drive_units`; 0 where they are made in double precision.
    """
    coherent = rows.largest[:, None] * blocks.norms
    blurred = units * coherent[:, :, -1]
    coherent[:, :, -1] = rows.norms[:, -1:] * blocks.largest[:, -1]
    flat = coherent.reshape(-1, economy.segments + 1)
    heard = np.full(len(flat), float(actuators))
    errors = economy.block_errors(flat, fft_samples, heard).reshape(blurred.shape) + blurred
    bounds: Float64Array = errors * np.sqrt(2.0 / fft_samples)
    return bounds
