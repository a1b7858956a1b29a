"""What a render is planned by before it starts: transform length, and a look at some of its blocks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.drive.band_choice import Sample
from rendering.drive.row_spectra import RowSpectra
from rendering.drive.window_spectra import magnitudes, rounding_of
from rendering.drive.windows import Weigh
from rendering.scene.emission import Emission

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

SAMPLED_BLOCKS = 3
SAMPLED_WINDOWS = 8
"""Blocks, and windows in each, that are looked at to choose the bins worth computing."""
LEAST_HOP_SAMPLES = 512
HOPS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0, 1.5, 2.0, 3.0, 4.0)
"""Hops that are weighed, relative to how far one event reaches."""
TRANSFORM_S = 0.35e-9
PRODUCT_S = 1.5e-9
OUTPUT_S = 0.6e-9
"""Seconds per sample and factor 2 of a transform, per bin and actuator of a product, per sample that overlap-add
touches. Measured with scipy's transforms in float64 on a 2.5 GHz Xeon; only their ratios matter, and not much."""


def choose_fft_samples(
    reach: int, span: int, actuators: int, focus_position: Int64Array, nodes: int, multiple: int = 1
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
    multiple : int
        Of which the transform length is one.

    Returns
    -------
    fft_samples, hop : int
        hop = fft_samples - reach + 1.
    """
    rows = nodes * len(np.unique(focus_position))
    moves = nodes * np.count_nonzero(np.diff(focus_position))
    best, least = (0, 0), np.inf
    for hop in sorted({min(span, max(LEAST_HOP_SAMPLES, int(share * reach))) for share in HOPS}):
        fft_samples = multiple * int(scipy_fft.next_fast_len(-(-(reach + hop - 1) // multiple), real=True))
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


def sample_blocks(
    emission: Emission, spectra: RowSpectra, weigh: Weigh, fft_samples: int, starts: range
) -> tuple[list[Sample], list[list[int]]]:
    """Look at some windows of some blocks; tells also which row each of them is of.

    Parameters
    ----------
    emission : Emission
        The source in time.
    spectra : RowSpectra
        Rows in all bins; each that is looked at costs a transform.
    weigh : callable
        Weighs the windows.
    fft_samples : int
        Transform length.
    starts : range
        First samples of the blocks.
    """
    begun = []
    for block in np.unique(np.linspace(0, len(starts) - 1, SAMPLED_BLOCKS).astype(int)).tolist():
        windows = emission.windows(starts[block], starts.step, 1, weigh)
        every = max(1, -(-len(windows) // SAMPLED_WINDOWS))
        chosen = np.arange(0, len(windows), every)
        rows = windows.rows[chosen].tolist()
        if rows:
            spectra.prepare(rows)
            begun.append((windows, chosen, every, rows, spectra.view(rows)))
    samples = []
    # When the rows of all of them are being transformed, the windows are looked at, which takes no rows.
    for windows, chosen, every, _, view in begun:
        found = magnitudes(windows, chosen, fft_samples, spectra.economy)
        errors, blurs = rounding_of(windows, chosen, fft_samples)
        greens = view.magnitudes()
        blurred = np.minimum(np.linalg.norm(greens, axis=1) * errors, greens.max(axis=1) * blurs)
        samples.append(Sample(found, greens, float(every), blurred))
    return samples, [rows for _, _, _, rows, _ in begun]
