"""Which bins are worth computing, and in which precision: estimated from a few windows before the work starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rendering.drive.omission import Economy, choose_bins

Float64Array = NDArray[np.float64]

CAUTION = 0.9
"""Share of the tolerance that the estimated bound may fill; the proved one is found only afterwards."""
STRICTEST = 1e4


@dataclass(frozen=True, slots=True)
class Sample:
    """Some of the windows whose sum one block is.

    Parameters
    ----------
    windows : float64 array, shape (windows, bins)
        Magnitudes of windows.
    greens : float64 array, shape (windows, bins)
        Magnitudes of what each is multiplied with; over several actuators, their norms.
    repeats : float
        How many windows each stands for.
    errors : float64 array, shape (windows,)
        Bounds on what rounding of windows in single precision makes of the norms of their products.
    """

    windows: Float64Array
    greens: Float64Array
    repeats: float
    errors: Float64Array


def sampled_energy(samples: Sequence[Sample]) -> float:
    """Energy of the blocks that samples are of, windows added up out of phase."""
    return sum(item.repeats * float(np.square(item.windows * item.greens).sum()) for item in samples)


def quietest(samples: Sequence[Sample]) -> float:
    """Largest bin times norm of the window that makes least of its block: a low bound on what leaving it out costs."""
    sizes = [item.windows.max(axis=1) * np.linalg.norm(item.greens, axis=1) for item in samples if len(item.windows)]
    return min((float(size.min()) for size in sizes), default=0.0)


def choose_economy(
    samples: Sequence[Sample], fft_samples: int, overlap: int, tolerance: float, spent: float = 0.0
) -> Economy:
    """Choose bins and precision so that the bound, estimated from samples of some blocks, holds.

    Parameters
    ----------
    samples : sequence of Sample
        Each of another block.
    fft_samples : int
        Transform length.
    overlap : int
        Blocks that one sample lies in.
    tolerance : float
        Relative magnitude that may be left out, > 0.
    spent : float
        What of it is spent otherwise.
    """
    bins = fft_samples // 2 + 1
    everything = Economy.of(bins)
    energy = sampled_energy(samples)
    if not (energy > 0 and np.isfinite(energy)):
        return everything
    in_phase = [item.repeats * (item.windows * item.greens).sum(axis=0) for item in samples]
    contribution = np.sum(np.square(in_phase), axis=0)
    blurred = [_rounding(item, fft_samples) for item in samples]
    rounding = float(np.sqrt(overlap * np.sum(np.square(blurred)) / energy))
    single = bool(rounding < CAUTION / 2 * tolerance)
    allowed = CAUTION * tolerance - spent - (rounding if single else 0.0)
    squares = [(item.repeats, np.square(item.windows), np.square(item.greens)) for item in samples]
    aim = tolerance / 2
    while aim > tolerance / STRICTEST:
        economy = Economy.of(bins, *choose_bins(contribution, aim), single=single)
        if economy.kept == bins:
            break
        left_out = [_left_out(economy, fft_samples, *item) for item in squares]
        estimate = np.sqrt(overlap * np.sum(np.square(left_out)) / energy)
        if estimate <= allowed:
            return economy
        # Spectra fall steeply at the ends of the band: what is left out is about in proportion to the aim.
        aim *= float(np.clip(allowed / estimate, 0.2, 0.93))
    return Economy.of(bins, single=single)


def _rounding(sample: Sample, fft_samples: int) -> float:
    """Bound on what rounding in single precision does to a block."""
    norms = np.linalg.norm(sample.greens, axis=1)
    single = Economy.of(fft_samples // 2 + 1, single=True)
    units = float(single.rounding(fft_samples, np.array(sample.repeats * len(norms))))
    return float(sample.repeats * (norms * units * sample.windows.max(axis=1, initial=0.0) + sample.errors).sum())


def _left_out(economy: Economy, fft_samples: int, repeats: float, windows: Float64Array, greens: Float64Array) -> float:
    """Bound on what leaving out bins does to a block, from the squares of some windows and their partners."""
    norms = np.sqrt(np.add.reduceat(greens, economy.starts, axis=1))
    share = repeats * economy.largest(windows)[:, :-1] * norms
    coherent = np.append(share.sum(axis=0), 0.0)[None]
    return float(economy.block_errors(coherent, fft_samples, np.zeros(1, dtype=np.int64))[0])
