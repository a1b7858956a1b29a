"""Frequency bins that are computed, in which precision, and the proof of what single precision leaves out.

In one block the spectrum of actuator i's drive is F_i = sum_J U_J G_iJ over the windows J of bank rows. A transform of
n samples errs by at most 8 log2(n) units of roundoff of its norm (N. Higham, Accuracy and Stability of Numerical
Algorithms, 2nd ed., theorem 24.2: 6.7 per factor 2), a product or sum by one unit per term. With
c = sum_J max|U_J| |G_J|_2 all of it is at most `units` times c, see `Band.rounding_error`: a row's error may lie in any
bin, and so meet the largest value of its window. By Parseval the error in time is sqrt(2 / n) times that, twice per bin
for the two signs of frequency. A sample lies in at most q = ceil(n / hop) blocks, so by Cauchy-Schwarz the blocks'
errors add up to at most sqrt(q * sum of squares). Relative to drives without omission: error / (norm computed - error).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import Float64Array
from wavefocus.storage.errors import InputError

UNDERFLOW = 2.0**-100
"""Bounds what products in single precision lose below their smallest normal number, per unit of rows and windows."""


@dataclass(frozen=True, slots=True)
class Band:
    """The bins of a transform that are computed: those from 0 to `kept` - 1.

    fft_samples: Transform length n.
    kept: How many bins are computed.
    single: Products in complex64.
    """

    fft_samples: int
    kept: int
    single: bool = False

    @property
    def bins(self) -> int:
        """Bins of the whole spectrum."""
        return self.fft_samples // 2 + 1

    @property
    def real(self) -> type[np.float32] | type[np.float64]:
        """Type of samples."""
        return np.float32 if self.single else np.float64

    @property
    def complex(self) -> type[np.complex64] | type[np.complex128]:
        """Type of spectra."""
        return np.complex64 if self.single else np.complex128

    def rounding_error(self, coherent: float, terms: float) -> float:
        """Bound on the norm in time of what single precision costs one block; 0 in double precision.

        coherent: c.
        terms: How many products were added up.
        """
        if not self.single:
            return 0.0
        # Three transforms (of a row, of a window, and back), 8 units of roundoff per factor 2 of their length.
        units = (3.0 * 8.0 * math.log2(max(self.fft_samples, 2)) + terms + 20.0) * 2.0**-24
        return math.sqrt(2.0 / self.fft_samples) * (units * coherent + UNDERFLOW * terms)


def tolerance_of(tolerance_db: float | None) -> float:
    """A tolerance as a relative magnitude, 0 where there is none.

    Raises InputError: it is not a finite number below 0.
    """
    if tolerance_db is None:
        return 0.0
    if not (math.isfinite(tolerance_db) and tolerance_db < 0):
        raise InputError(f"tolerance_db is {tolerance_db}; it must be a finite number below 0")
    return float(10.0 ** (tolerance_db / 20.0))


def relative_bound(error: float, norm: float) -> float:
    """Bound on an error relative to what would be without it, infinity where none is proved.

    error: Bound on the error's norm.
    norm: Norm of what was computed.
    """
    if error == 0.0:
        return 0.0
    remaining = norm - error
    return error / remaining if remaining > 0 else float("inf")


def row_norms(values: NDArray[Any]) -> Float64Array:
    """Euclidean norm of each row, in double precision."""
    # Not the dot product, which may wait for threads that are busy elsewhere.
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", values, values, dtype=np.float64)))


def power_over(spectra: NDArray[Any], axis: int) -> Float64Array:
    """Squares of magnitudes added up over an axis, in double precision."""
    parts = np.ascontiguousarray(spectra).view(spectra.real.dtype)
    squares = np.square(parts, dtype=np.float64).sum(axis=axis)
    return np.asarray(squares[..., ::2] + squares[..., 1::2])
