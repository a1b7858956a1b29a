"""What a render needs to compute: transform length, frequency bins and precision, chosen before it starts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.emission import Emission, Weigh
from rendering.omission import TRANSFORMS, Economy, choose_bins

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

SAMPLED_BLOCKS = 3
SAMPLED_WINDOWS = 8
"""Blocks, and windows in each, that are looked at to choose the bins worth computing."""
CAUTION = 0.9
"""Share of the tolerance that the estimated bound may fill; the proved one is found only afterwards."""
STRICTEST = 1e4
LEAST_HOP_SAMPLES = 512
HOPS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0, 1.5, 2.0, 3.0, 4.0)
"""Hops that are weighed, relative to how far one event reaches."""
TRANSFORM_S = 0.35e-9
PRODUCT_S = 1.5e-9
OUTPUT_S = 0.6e-9
"""Seconds per sample and factor 2 of a transform, per bin and actuator of a product, per sample that overlap-add
touches. Measured with scipy's transforms in float64 on a 2.5 GHz Xeon; only their ratios matter, and not much."""


def choose_fft_samples(
    reach: int, span: int, actuators: int, focus_position: Int64Array, nodes: int
) -> tuple[int, int]:
    """Choose the transform length by what transforms, products and overlap-add will cost.

    Long blocks waste less on their overlap, short ones less on rows that emit briefly.

    Parameters
    ----------
    reach : int
        Samples of drive that one event makes.
    span : int
        Samples over which events begin.
    actuators : int
        Number of actuators.
    focus_position : int64 array, shape (points,)
        Row of each path point.
    nodes : int
        Rows that make one path point.

    Returns
    -------
    fft_samples, hop : int
        hop = fft_samples - reach + 1.
    """
    rows = nodes * len(np.unique(focus_position))
    moves = nodes * np.count_nonzero(np.diff(focus_position))
    best, least = (0, 0), np.inf
    for hop in sorted({min(span, max(LEAST_HOP_SAMPLES, int(share * reach))) for share in HOPS}):
        fft_samples = int(scipy_fft.next_fast_len(reach + hop - 1, real=True))
        blocks = -(-span // (fft_samples - reach + 1))
        pairs = moves + nodes * blocks
        transform_s = TRANSFORM_S * fft_samples * np.log2(fft_samples)
        cost_s = (
            transform_s * (actuators * (rows + blocks) + pairs)
            + PRODUCT_S * pairs * actuators * fft_samples / 2
            + OUTPUT_S * blocks * actuators * fft_samples
        )
        if cost_s < least:
            best, least = (fft_samples, fft_samples - reach + 1), cost_s
    return best


def choose_economy(
    emission: Emission,
    weigh: Weigh,
    norms_of: Callable[[int], Float64Array],
    fft_samples: int,
    starts: range,
    tolerance: float,
) -> Economy:
    """Choose bins and precision so that the bound, estimated from some windows of some blocks, holds.

    Parameters
    ----------
    emission : Emission
        The source in time.
    weigh : callable
        Weighs the windows.
    norms_of : callable
        Norms over the actuators of a row's spectrum, (bins,).
    fft_samples : int
        Transform length.
    starts : range
        First samples of the blocks.
    tolerance : float
        Relative magnitude that may be left out; 0 for everything in double precision.
    """
    bins = fft_samples // 2 + 1
    everything = Economy.of(bins)
    if tolerance == 0:
        return everything
    places = np.unique(np.linspace(0, len(starts) - 1, SAMPLED_BLOCKS).astype(int))
    samples = [_sample(emission, weigh, norms_of, fft_samples, starts[place], starts.step) for place in places.tolist()]
    in_phase = [(item[2] * item[0] * item[1]).sum(axis=0) for item in samples]
    contribution = np.sum(np.square(in_phase), axis=0)
    energy = sum(float((item[2] * np.square(item[0] * item[1])).sum()) for item in samples)
    overlap = -(-fft_samples // starts.step)
    if not (energy > 0 and np.isfinite(energy)):
        return everything
    whole = [(item[2][:, 0] * item[0].max(axis=1) * np.linalg.norm(item[1], axis=1)).sum() for item in samples]
    rounding = TRANSFORMS * np.log2(fft_samples) * 2.0**-24 * np.sqrt(overlap * np.sum(np.square(whole)) / energy)
    single = bool(rounding < CAUTION / 2 * tolerance)
    allowed = CAUTION * tolerance - (rounding if single else 0.0)
    aim = tolerance / 2
    while aim > tolerance / STRICTEST:
        economy = Economy.of(bins, *choose_bins(contribution, aim), single=single)
        if economy.kept == bins:
            break
        left_out = []
        for windows, greens, repeats in samples:
            share = repeats * economy.largest(np.square(windows)) * economy.norms(greens)
            left_out.append(economy.block_error(share.sum(axis=0)[None], fft_samples, 0))
        if np.sqrt(overlap * np.sum(np.square(left_out)) / energy) <= allowed:
            return economy
        aim *= 0.75
    return Economy.of(bins, single=single)


def _sample(
    emission: Emission,
    weigh: Weigh,
    norms_of: Callable[[int], Float64Array],
    fft_samples: int,
    start: int,
    hop: int,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Magnitudes of some windows of a block, of their rows, and how many windows each stands for.

    Three arrays, (windows, bins), (windows, bins) and (windows, 1): rows cost a transform each.
    """
    bins = fft_samples // 2 + 1
    windows, greens, repeats = [np.zeros((0, bins))], [np.zeros((0, bins))], [np.zeros((0, 1))]
    for batch in emission.windows(start, min(start + hop, emission.stop_event), fft_samples, weigh):
        every = -(-len(batch.rows) // SAMPLED_WINDOWS)
        windows.append(np.abs(batch.spectra[::every]))
        greens.append(np.array([norms_of(row) for row in batch.rows[::every].tolist()]))
        repeats.append(np.full((len(windows[-1]), 1), float(every)))
    return np.concatenate(windows), np.concatenate(greens), np.concatenate(repeats)
