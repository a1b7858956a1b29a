"""Leaving out frequency bins, and the proof of how little that changes the drives.

In a block, actuator i's spectrum is F_i = sum_J U_J G_iJ over the windows J. Over a group of bins that is
left out,

    |F_i|_2 <= sum_J max |U_J| * |G_iJ|_2                        (triangle inequality and Hoelder)

and the error in time is that norm over sqrt(fft) by Parseval, twice per bin for the two signs of frequency. A
sample lies in at most q = ceil(fft / hop) blocks, so by Cauchy-Schwarz the blocks' errors add to at most
sqrt(q * sum of squares). The same sum over all bins, times the unit roundoff and the number of operations,
bounds the rounding. Relative to the drives without omission: error / (norm computed - error).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Int64Array = NDArray[np.int64]

MOST_KEPT = 0.9
"""Beyond this share of kept bins, leaving out the rest saves nothing."""
ROUNDOFF = 2.0**-53


@dataclass(frozen=True, slots=True)
class Omission:
    """Which bins of a spectrum are computed, and how the others are grouped for the bound.

    Parameters
    ----------
    kept : int64 array, shape (kept,)
        Bins computed, ascending.
    rest : int64 array, shape (left out,)
        The other bins, group by group.
    starts : int64 array, shape (groups,)
        Where in `rest` each group starts.
    membership : float64 array, shape (bins, groups + 1)
        1 where a bin belongs to a group; all bins belong to the last.
    """

    kept: Int64Array
    rest: Int64Array
    starts: Int64Array
    membership: Float64Array

    @classmethod
    def of(cls, kept: NDArray[np.bool_]) -> Omission:
        """Group what is left out by its distance from the nearest kept bin, in half octaves.

        Near the kept band spectra fall steeply, so that a coarse group would take its largest window from one
        end and most of its Green's functions from the other.

        Parameters
        ----------
        kept : bool array, shape (bins,)
            Which bins are computed; at least one is, and at least one is not.
        """
        chosen, rest = np.flatnonzero(kept), np.flatnonzero(~kept)
        above = np.searchsorted(chosen, rest)
        to_next = np.abs(chosen[np.minimum(above, len(chosen) - 1)] - rest)
        to_previous = np.abs(rest - chosen[np.maximum(above - 1, 0)])
        half_octave = np.floor(2.0 * np.log2(np.minimum(to_next, to_previous))).astype(np.int64)
        order = np.argsort(half_octave, kind="stable")
        starts = np.flatnonzero(np.diff(half_octave[order], prepend=-1))
        membership = np.zeros((len(kept), len(starts) + 1))
        membership[:, -1] = 1.0
        group = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(rest)))
        membership[rest[order], group] = 1.0
        return cls(chosen, rest[order], starts, membership)

    def largest(self, spectra: ComplexArray | Float64Array) -> Float64Array:
        """Largest magnitude in each group, then over all bins, (..., groups + 1)."""
        magnitude = np.abs(spectra)
        grouped = np.maximum.reduceat(magnitude[..., self.rest], self.starts, axis=-1)
        return np.concatenate([grouped, magnitude.max(axis=-1, keepdims=True)], axis=-1)

    def norms(self, spectra: ComplexArray | Float64Array) -> Float64Array:
        """Euclidean norm of each group, then over all bins, (..., groups + 1)."""
        square = np.square(spectra.real) + np.square(spectra.imag)
        norms: Float64Array = np.sqrt(square @ self.membership)
        return norms


@dataclass(slots=True)
class ErrorBudget:
    """Adds up the proved bounds of one emission's blocks."""

    fft_samples: int
    hop_samples: int
    _blocks: list[float] = field(default_factory=list)

    def add_block(self, coherent: Float64Array, windows: int) -> None:
        """Add one block.

        Parameters
        ----------
        coherent : float64 array, shape (actuators, groups + 1)
            sum_J max |U_J| |G_iJ|_2 per actuator and group; the last column is over all bins.
        windows : int
            Number of windows J that were summed.
        """
        operations = 16.0 * np.log2(self.fft_samples) + windows + 8.0
        rounding = scaled_norm(coherent[:, -1]) * operations * ROUNDOFF
        left_out = scaled_norm(coherent[:, :-1])
        self._blocks.append((left_out + rounding) * float(np.sqrt(2.0 / self.fft_samples)))

    @property
    def error(self) -> float:
        """Bound on the Euclidean norm of the error of all actuators' drives."""
        overlap = -(-self.fft_samples // self.hop_samples)
        return float(np.sqrt(overlap)) * scaled_norm(np.array(self._blocks))


def scaled_norm(values: Float64Array) -> float:
    """Euclidean norm that neither over- nor underflows."""
    peak = float(max(values.max(initial=0.0), -values.min(initial=0.0)))
    if peak == 0.0 or not np.isfinite(peak):
        return peak
    if 1e-140 < peak < 1e140:
        return float(np.linalg.norm(values))
    return peak * float(np.linalg.norm(values / peak))


def relative_bound(error: float, drive_v: Float64Array) -> float:
    """Bound on the error relative to the drives without omission, infinity where none is proved.

    Parameters
    ----------
    error : float
        Bound on the error's norm.
    drive_v : float64 array, shape (actuators, samples)
        The drives as computed.
    """
    if error == 0.0:
        return 0.0
    remaining = scaled_norm(np.array([scaled_norm(row) for row in drive_v])) - error
    return error / remaining if remaining > 0 else float("inf")


def choose_bins(contribution: Float64Array, tolerance: float) -> NDArray[np.bool_]:
    """Keep the strongest bins until the rest is below the tolerance.

    Parameters
    ----------
    contribution : float64 array, shape (bins,)
        Estimated square of each bin's share in the drives, windows and actuators added in phase.
    tolerance : float
        Relative magnitude of what may be left out, 0 to keep all.

    Returns
    -------
    bool array, shape (bins,)
    """
    order = np.argsort(contribution)
    rest = np.cumsum(contribution[order])
    left_out = rest <= tolerance**2 * rest[-1] if rest[-1] > 0 else np.zeros(len(order), dtype=bool)
    kept = np.ones(len(order), dtype=bool)
    kept[order[left_out]] = False
    if np.count_nonzero(kept) > MOST_KEPT * len(kept):
        kept[:] = True
    return kept
