"""Leaving out frequency bins and digits, and the proof of how little that changes the drives.

In a block, actuator i's spectrum is F_i = sum_J U_J G_iJ over the windows J. Over a segment of bins that is
left out,

    |F_i|_2 <= sum_J max |U_J| * |G_iJ|_2                        (triangle inequality and Hoelder)

and the error in time is that norm over sqrt(fft) by Parseval, twice per bin for the two signs of frequency. A
sample lies in at most q = ceil(fft / hop) blocks, so by Cauchy-Schwarz the blocks' errors add to at most
sqrt(q * sum of squares). The same sum over all bins, times the unit roundoff and the number of operations,
bounds the rounding: a transform of n samples errs by at most 8 log2(n) units of its norm (N. Higham, Accuracy
and Stability of Numerical Algorithms, 2nd ed., theorem 24.2: 6.7 per factor 2). Relative to the drives without
omission: error / (norm computed - error).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

MOST_KEPT = 0.9
"""Beyond this share of kept bins, leaving out the rest saves nothing."""
TRANSFORMS = 20.0
"""Units of roundoff per factor 2 of the transform length: the row's and the block's transform err by 8 each;
the row's error counts in the bins kept and in the norms of the others, together by sqrt(2)."""
SQUARES_SLACK = 1.002
"""Norms that are summed in single precision are too small by less than this: 2**15 terms at 2**-24 each."""
SQUARES_LOST = 2.0**-62
"""What they lose per bin below the square root of the smallest normal number, or by `FLUSH` in the row."""
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
        end and most of its Green's functions from the other.
        """
        high = bins if high is None else high
        distance = np.unique(np.floor(2.0 ** (0.5 * np.arange(2 * int(bins).bit_length() + 2)))).astype(np.int64)
        below, above = low - distance[::-1], high - 1 + distance
        starts = np.concatenate([[0], below[(below > 0) & (low > 0)] + 1, [low], above[above < bins]])
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
        largest = np.sqrt(np.maximum.reduceat(squared, self.starts, axis=-1)).astype(np.float64)
        if self.single:
            largest = largest * SQUARES_SLACK + SQUARES_LOST
        return np.concatenate([largest, largest.max(axis=-1, keepdims=True)], axis=-1)

    def norms(self, spectra: NDArray[Any]) -> Float64Array:
        """Euclidean norm of each segment, then over all bins, no smaller than rounding, (..., segments + 1)."""
        parts = np.square(spectra.view(spectra.real.dtype))
        pairs = parts.shape[-1] // self.bins
        square = np.add.reduceat(parts, pairs * self.starts, axis=-1).astype(np.float64)
        norms: Float64Array = np.sqrt(np.concatenate([square, square.sum(axis=-1, keepdims=True)], axis=-1))
        if self.single:
            norms = norms * SQUARES_SLACK + np.sqrt(self.bins) * SQUARES_LOST
        return norms

    def block_error(self, coherent: Float64Array, fft_samples: int, windows: int) -> float:
        """Bound on the norm of the error of one block, over sqrt(2 / fft_samples).

        Parameters
        ----------
        coherent : float64 array, shape (actuators, segments + 1)
            sum_J max |U_J| |G_iJ|_2 per actuator and segment; the last column is over all bins.
        fft_samples : int
            Transform length.
        windows : int
            Number of windows J that were summed.
        """
        left_out = (self.starts < self.low) | (self.starts >= self.high)
        roundoff = 2.0**-24 if self.single else 2.0**-53
        # A row's error may lie in any bin, and so meet the largest of all a window's values.
        rounding = (TRANSFORMS * np.log2(fft_samples) + windows + 16.0) * roundoff * scaled_norm(coherent[:, -1])
        if self.single:
            rounding += UNDERFLOW * windows * np.sqrt(coherent.shape[0] * fft_samples)
        return scaled_norm(coherent[:, :-1][:, left_out]) + float(rounding)


@dataclass(slots=True)
class ErrorBudget:
    """Adds up the proved bounds of one emission's blocks."""

    fft_samples: int
    hop_samples: int
    _blocks: list[float] = field(default_factory=list)

    def add_block(self, error: float) -> None:
        """Add one block's `Economy.block_error`, in volts."""
        self._blocks.append(error * float(np.sqrt(2.0 / self.fft_samples)))

    @property
    def error(self) -> float:
        """Bound on the Euclidean norm of the error of all actuators' drives."""
        overlap = -(-self.fft_samples // self.hop_samples)
        return float(np.sqrt(overlap)) * scaled_norm(np.array(self._blocks))


def scaled_norm(values: Float64Array) -> float:
    """Euclidean norm that neither over- nor underflows."""
    flat = values.reshape(-1)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        square = float(np.dot(flat, flat))
    if 1e-280 < square < np.inf:
        return float(np.sqrt(square))
    peak = float(max(values.max(initial=0.0), -values.min(initial=0.0)))
    if peak == 0.0 or not np.isfinite(peak):
        return peak
    return peak * float(np.linalg.norm(values / peak))


def row_norms(drive_v: Float64Array) -> Float64Array:
    """Norm of each row: drives may be long, and a copy of them all is not needed for a figure."""
    return np.array([scaled_norm(row) for row in drive_v])


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
