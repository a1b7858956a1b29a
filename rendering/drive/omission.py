"""Leaving out frequency bins and digits, and the proof of how little that changes the drives.

In a block, actuator i's spectrum is F_i = sum_J U_J G_iJ over the windows J. Over a segment of bins that is
left out, and over all actuators i,

    |F|_2 <= sum_J max |U_J| * |G_J|_2                           (triangle inequality and Hoelder)

and the error in time is that norm over sqrt(fft) by Parseval, twice per bin for the two signs of frequency. A
sample lies in at most q = ceil(fft / hop) blocks, so by Cauchy-Schwarz the blocks' errors add to at most
sqrt(q * sum of squares). The same sum over all bins, times the unit roundoff and the number of operations,
bounds the rounding: a transform of n samples errs by at most 8 log2(n) units of its norm (N. Higham, Accuracy
and Stability of Numerical Algorithms, 2nd ed., theorem 24.2: 6.7 per factor 2). A row's error falls either into
the bins computed or into those whose norm it falsifies, so counts once; that of a window transformed in single
precision is a vector that meets at most the largest magnitude of its row; the transform back errs in proportion
to the block that it makes. Relative to the drives without omission: error / (norm computed - error).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from storage.errors import InputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

MOST_KEPT = 0.9
"""Beyond this share of kept bins, leaving out the rest saves nothing."""
TRANSFORM = 8.0
"""Units of roundoff per factor 2 of the transform length."""
SQUARES_SLACK = 1.002
"""Norms that are summed in single precision are too small by less than this: 2**15 terms at 2**-24 each."""
SQUARES_LOST = 2.0**-62
"""What they lose per bin below the square root of the smallest normal number, or by `FLUSH` in the row."""
SEGMENT_BINS = 6
"""Shortest segment, and the distance from the bins computed at which longer ones begin."""
LEAST_NORM = 1e-140
"""Norms above this are not falsified by squares that vanish."""
MOST_ACTUATORS = 2.0**16
UNDERFLOW = 2.0**-100
"""Bounds, per window and relative to windows and rows of size 1, what products in single precision lose below
their smallest normal number, 2**-126, in transforms of up to 2**25 samples."""


@dataclass(frozen=True, slots=True)
class Economy:
    """Which bins of a spectrum are computed, in which precision, and how the others are grouped for the bound.

    Parameters
    ----------
    bins : int
        Bins of a whole spectrum.
    low, high : int
        Bins computed are low <= bin < high.
    single : bool
        Products and transforms in complex64.
    starts : int64 array, shape (segments,)
        First bin of each segment; all bins belong to one of them, those computed make one of their own.
    """

    bins: int
    low: int
    high: int
    single: bool
    starts: Int64Array

    @classmethod
    def of(cls, bins: int, low: int = 0, high: int | None = None, *, single: bool = False) -> Economy:
        """Cut what is left out into segments of half an octave of distance from the bins computed.

        Near the band spectra fall steeply, so that a coarse segment would take its largest window from one
        end and most of its Green's functions from the other; yet each costs as much as a hundred bins.
        """
        high = bins if high is None else high
        distance = np.floor(SEGMENT_BINS * 2.0 ** (0.5 * np.arange(2 * int(bins).bit_length()))).astype(np.int64)
        below, above = low - distance[::-1], high - 1 + distance
        starts = np.concatenate([[0], below[(below > 0) & (low > 0)] + 1, [low], [high], above[above < bins]])
        return cls(bins, low, high, single, np.unique(starts[starts < bins]).astype(np.int64))

    @property
    def exact(self) -> bool:
        """Whether nothing is left out."""
        return not self.single and self.kept == self.bins

    @property
    def kept(self) -> int:
        """Number of bins computed."""
        return self.high - self.low

    @property
    def real(self) -> type[np.float32] | type[np.float64]:
        """Type of samples."""
        return np.float32 if self.single else np.float64

    @property
    def complex(self) -> type[np.complex64] | type[np.complex128]:
        """Type of spectra."""
        return np.complex64 if self.single else np.complex128

    @property
    def segments(self) -> int:
        """Number of segments, that of the bins computed included."""
        return len(self.starts)

    def squared(self, spectra: NDArray[Any]) -> NDArray[Any]:
        """Squares of magnitudes, without the care that numpy's abs takes."""
        parts = np.square(spectra.view(self.real))
        squared: NDArray[Any] = np.add(parts[..., ::2], parts[..., 1::2])
        return squared

    def largest(self, squared: NDArray[Any]) -> Float64Array:
        """Largest magnitude in each segment, then over all bins, (..., segments + 1), no smaller than rounding.

        Parameters
        ----------
        squared : float array, shape (..., bins)
            Squares of magnitudes.
        """
        return self.largest_of(np.maximum.reduceat(squared, self.starts, axis=-1))

    def largest_of(self, squared: NDArray[Any]) -> Float64Array:
        """The same, of the largest squares in each segment, (..., segments)."""
        largest = np.sqrt(squared).astype(np.float64)
        if self.single:
            largest = largest * SQUARES_SLACK + SQUARES_LOST
        return np.concatenate([largest, largest.max(axis=-1, keepdims=True)], axis=-1)

    def rounding(self, fft_samples: int, windows: Int64Array | Float64Array) -> Float64Array:
        """Bound on what rounding does to blocks of so many windows, relative to sum_J max |U_J| |G_J|_2."""
        units: Float64Array = TRANSFORM * np.log2(fft_samples) + windows + 20.0
        return units * self.roundoff

    @property
    def roundoff(self) -> float:
        """Unit roundoff."""
        return 2.0**-24 if self.single else 2.0**-53

    def block_errors(self, coherent: Float64Array, fft_samples: int, windows: Int64Array) -> Float64Array:
        """Bounds on the norms of the errors of some blocks, (blocks,), over sqrt(2 / fft_samples).

        Parameters
        ----------
        coherent : float64 array, shape (blocks, segments + 1)
            sum_J max |U_J| |G_J|_2 per segment; the last column is over all bins.
        fft_samples : int
            Transform length.
        windows : int64 array, shape (blocks,)
            Number of windows J that were summed.
        """
        left_out = (self.starts < self.low) | (self.starts >= self.high)
        # A row's error may lie in any bin, and so meet the largest of all a window's values.
        rounding = self.rounding(fft_samples, windows) * coherent[:, -1]
        if self.single:
            rounding += UNDERFLOW * windows * np.sqrt(MOST_ACTUATORS * fft_samples)
        errors: Float64Array = row_norms(coherent[:, :-1][:, left_out]) + rounding
        return errors


class ErrorBudget:
    """Adds up the proved bounds of one emission's blocks.

    Parameters
    ----------
    fft_samples : int
        Length of a block.
    overlap : int
        Most blocks that one sample lies in.
    """

    def __init__(self, fft_samples: int, overlap: int) -> None:
        self._scale = float(np.sqrt(2.0 / fft_samples))
        self._overlap = overlap
        self._errors: list[float] = []

    def add(self, first: int, errors: Float64Array) -> None:
        """Add `Economy.block_errors` of blocks from `first`; those of one block's parts add up."""
        self._errors.extend([0.0] * (first + len(errors) - len(self._errors)))
        for place, error in enumerate(errors.tolist(), first):
            self._errors[place] += error

    def norm(self, exponent: int = 0) -> float:
        """Bound on the Euclidean norm of the error of all actuators' drives, times two to a power."""
        with np.errstate(over="ignore", under="ignore"):
            norm = np.sqrt(float(self._overlap)) * self._scale * scaled_norm(np.array(self._errors))
            return float(np.ldexp(norm, exponent))


def scaled_norm(values: Float64Array) -> float:
    """Euclidean norm that neither over- nor underflows."""
    return float(row_norms(values.reshape(1, -1))[0])


def row_norms(values: Float64Array) -> Float64Array:
    """Euclidean norm of each row that neither over- nor underflows, without a copy of them all."""
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        # Not the dot product, which may wait for threads that are busy elsewhere.
        norms: Float64Array = np.sqrt(np.einsum("ij,ij->i", values, values))
    for place in np.flatnonzero(~((norms > LEAST_NORM) & (norms < np.inf))).tolist():
        row = values[place]
        peak = float(max(row.max(initial=0.0), -row.min(initial=0.0)))
        norms[place] = peak if peak == 0.0 or not np.isfinite(peak) else peak * float(np.linalg.norm(row / peak))
    return norms


def relative_bound(error: float, norms: Float64Array) -> float:
    """Bound on the error relative to the drives without omission, infinity where none is proved.

    Parameters
    ----------
    error : float
        Bound on the error's norm.
    norms : float64 array, shape (actuators,)
        Norms of the drives as computed.
    """
    if error == 0.0:
        return 0.0
    remaining = scaled_norm(norms) - error
    return error / remaining if remaining > 0 else float("inf")


def choose_bins(contribution: Float64Array, tolerance: float) -> tuple[int, int]:
    """Keep the bins between those that add up to less than the tolerance, at the lower and the upper end.

    Parameters
    ----------
    contribution : float64 array, shape (bins,)
        Estimated square of each bin's share in the drives, windows and actuators added in phase.
    tolerance : float
        Relative magnitude of what may be left out, 0 to keep all.

    Returns
    -------
    low, high : int
        low <= bin < high are kept.
    """
    total = float(contribution.sum())
    if not total > 0 or not np.isfinite(total):
        return 0, len(contribution)
    each = 0.5 * tolerance**2 * total
    low = int(np.searchsorted(np.cumsum(contribution), each, side="right"))
    high = len(contribution) - int(np.searchsorted(np.cumsum(contribution[::-1]), each, side="right"))
    if high - low > MOST_KEPT * len(contribution):
        return 0, len(contribution)
    return low, high


def tolerance_of(tolerance_db: float | None) -> float:
    """A tolerance as a relative magnitude, 0 where there is none.

    Raises
    ------
    InputError
        It is not a finite number below 0.
    """
    if tolerance_db is None:
        return 0.0
    if not (math.isfinite(tolerance_db) and tolerance_db < 0):
        raise InputError(f"tolerance_db is {tolerance_db}; it must be a finite number below 0")
    return float(10.0 ** (tolerance_db / 20.0))
