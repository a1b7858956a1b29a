"""The transform length that a render costs least with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rendering.device import fast_length

Int64Array = NDArray[np.int64]

LEAST_HOP_SAMPLES = 512
HOPS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0, 1.5, 2.0, 3.0, 4.0)
"""Hops that are weighed, relative to how far one event reaches."""
TRANSFORM_S = 0.35e-9
PRODUCT_S = 1.5e-9
OUTPUT_S = 0.6e-9
"""Seconds per sample and factor 2 of a transform, per bin and actuator of a product, per sample that overlap-add
touches. Measured with scipy's transforms in float64 on a 2.5 GHz Xeon; only their ratios matter, and not much."""


def choose_fft_samples(reach: int, span: int, actuators: int, focus_position: Int64Array, nodes: int) -> int:
    """Choose the transform length by what transforms, products and overlap-add will cost.

    Long blocks waste less on their overlap, short ones less on rows that emit briefly.

    reach: Samples of drive that one event makes.
    span: Samples over which events begin.
    focus_position, int64 (points,): Row of each path point.
    nodes: Rows that make one path point.
    """
    rows = nodes * len(np.unique(focus_position))
    moves = nodes * np.count_nonzero(np.diff(focus_position))
    best, least = 0, np.inf
    for hop in sorted({min(span, max(LEAST_HOP_SAMPLES, int(share * reach))) for share in HOPS}):
        fft_samples = fast_length(reach + hop - 1)
        blocks = -(-span // (fft_samples - reach + 1))
        pairs = moves + nodes * blocks
        transform_s = TRANSFORM_S * fft_samples * np.log2(fft_samples)
        cost_s = (
            transform_s * (actuators * (rows + blocks) + pairs)
            + PRODUCT_S * pairs * actuators * fft_samples / 2
            + OUTPUT_S * blocks * actuators * fft_samples
        )
        if cost_s < least:
            best, least = fft_samples, cost_s
    return best
