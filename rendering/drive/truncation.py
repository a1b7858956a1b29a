"""What of each bank row is left out: late taps, and actuators that hardly count."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendering.drive.band_choice import Sample, sampled_energy
from rendering.greens.row_scaling import RealArray

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

SHARE = 0.15
"""Share of the tolerance that late taps may take, weak actuators, and quiet windows, each."""
LEAST_TAPS = 32
FRACTIONS = np.arange(4, 14) / 16.0
"""Fractions of the taps that are tried: keeping more saves next to nothing."""


@dataclass(frozen=True, slots=True)
class RowCut:
    """The part of each row that is used.

    Parameters
    ----------
    taps : int
        Taps from the first.
    actuators : int64 array, shape (kept,)
        Actuators, ascending.
    all_actuators : int
        How many the bank has.
    whole : bool
        Whether that is all.
    """

    taps: int
    actuators: Int64Array
    all_actuators: int
    whole: bool

    @classmethod
    def nothing(cls, taps: int, actuators: int) -> RowCut:
        """Leave nothing out."""
        return cls(taps, np.arange(actuators), actuators, whole=True)

    def used(self, values: RealArray) -> RealArray:
        """The part of rows (..., actuators, taps) that is used."""
        return values[..., self.actuators, : self.taps]

    @property
    def weak_actuators(self) -> tuple[int, ...]:
        """Actuators that are not used."""
        return tuple(np.setdiff1d(np.arange(self.all_actuators), self.actuators).tolist())

    def spread(self, drives: NDArray[Any]) -> NDArray[Any]:
        """Drives of the actuators used (kept, samples) as those of all."""
        if len(self.actuators) == self.all_actuators:
            return drives
        spread = np.zeros((self.all_actuators, drives.shape[1]), dtype=drives.dtype)
        spread[self.actuators] = drives
        return spread

    def left_out(self, values: RealArray) -> Float64Array:
        """Norms of what is left out of rows (..., actuators, taps)."""
        rest = values.astype(np.float64)
        rest[..., self.actuators, : self.taps] = 0.0
        norms: Float64Array = np.sqrt(np.einsum("...it,...it->...", rest, rest)) * (1.0 + 1e-9)
        return norms

    def left_out_of(self, energies: Float64Array) -> float:
        """The same of a row whose energies, (2, actuators), are those of the taps used and of the others."""
        rest = energies[1] + energies[0]
        rest[self.actuators] = energies[1][self.actuators]
        return float(np.sqrt(rest.sum())) * (1.0 + 1e-9)


def choose_cut(
    samples: Sequence[Sample],
    rows: Sequence[Sequence[int]],
    read: Callable[[int], RealArray],
    shape: tuple[int, int],
    fft_samples: int,
    overlap: int,
    tolerance: float,
) -> tuple[RowCut, float]:
    """Choose what to leave out by a look at some windows of some blocks.

    Parameters
    ----------
    samples : sequence of Sample
        Each of another block.
    rows : sequence of sequences of int
        The row of each of a sample's windows.
    read : callable
        Gives a row, (actuators, taps); asked at most once for each.
    shape : tuple of int
        Actuators and taps of a row.
    fft_samples : int
        Transform length.
    overlap : int
        Blocks that one sample lies in.
    tolerance : float
        Relative magnitude that may be left out.

    Returns
    -------
    cut : RowCut
    spent : float
        Estimate of what it takes of the tolerance.
    """
    actuators, taps = shape
    whole = RowCut.nothing(taps, actuators)
    energy = sampled_energy(samples)
    if not (energy > 0 and np.isfinite(energy)):
        return whole, 0.0
    # Of what may be left out, the share of each block: actuator by actuator, and tap by tap from the end.
    ends = (FRACTIONS * taps).astype(int) if taps >= LEAST_TAPS else np.zeros(0, dtype=int)
    norms: dict[int, tuple[Float64Array, Float64Array]] = {}
    by_actuator, by_tap = np.zeros((len(samples), actuators)), np.zeros((len(samples), len(ends)))
    scale = np.sqrt(overlap * fft_samples / 2.0 / energy)
    for place, (sample, some) in enumerate(zip(samples, rows, strict=True)):
        for window, row in zip(sample.windows, some, strict=True):
            if row not in norms:
                norms[row] = _norms(read(row), ends)
            largest = sample.repeats * float(window.max())
            by_actuator[place] += largest * norms[row][0]
            by_tap[place] += largest * norms[row][1]
            joint = scale * np.linalg.norm(by_actuator, axis=0)
            late = scale * np.linalg.norm(by_tap, axis=0)
            if min(joint.min(), late.min(initial=np.inf)) > SHARE * tolerance:
                # They only grow: nothing can be left out, and most rows need not be read.
                return whole, 0.0
    order = np.argsort(joint)
    weak = int(np.searchsorted(np.sqrt(np.cumsum(np.square(joint[order]))), SHARE * tolerance))
    enough = np.flatnonzero(late <= SHARE * tolerance)
    kept_taps = int(ends[enough[0]]) if len(enough) else taps
    kept = np.sort(order[min(weak, actuators - 1) :])
    if len(kept) == actuators and kept_taps == taps:
        return whole, 0.0
    spent = float(np.linalg.norm(joint[order[: actuators - len(kept)]])) + (
        float(late[enough[0]]) if len(enough) else 0.0
    )
    return RowCut(kept_taps, kept.astype(np.int64), actuators, whole=False), spent


def _norms(green: RealArray, ends: Int64Array) -> tuple[Float64Array, Float64Array]:
    """Norms of each actuator, and of all of them from each of some taps on."""
    # No more than an estimate is needed, and what is small is last.
    energy = np.add.reduceat(np.square(green), np.append(0, ends), axis=1).astype(np.float64)
    return np.sqrt(energy.sum(axis=1)), np.sqrt(np.cumsum(energy.sum(axis=0)[::-1])[::-1][1:])
