"""Samples that a converter or an amplifier has cut off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# A converter's last counts belong to clipping: 0.1 % below the end of the range.
CLIP_SHARE = 0.999
# A flat top: this many samples within 0.1 % of the recording's own peak, and a quarter of all within 3 %.
# A sine has 18 % of them there, noise and sweeps over resonances 5 %.
LEAST_FLAT = 8
# Where a sweep is cut off, it is cut off many times running: this much on both sides of the peak shows it.
AROUND_SAMPLES = 4096
BELOW_SHARE = 0.97
# Smaller recordings have too few converter steps to distinguish a flat top from a coarse one.
LEAST_PEAK_SHARE = 0.05


def find_peaks(channel: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Largest magnitude of each recording and where it is, from recordings (records, samples)."""
    rows = np.arange(channel.shape[0])
    highest = np.array([recording.argmax() for recording in channel])
    lowest = np.array([recording.argmin() for recording in channel])
    up, down = channel[rows, highest], -channel[rows, lowest]
    return np.maximum(up, down), np.where(up >= down, highest, lowest)


def count_clipped(
    channel: NDArray[np.float32], peak_v: NDArray[np.float32], place: NDArray[np.int64], range_v: float
) -> NDArray[np.int32]:
    """Count the clipped samples of each recording.

    These are samples at 0.999 of the range or beyond, or else those of a flat top below it, since what comes
    before the converter clips too. A flat top blurred by noise that was added after it is not seen;
    the fit's residual is what shows it then.

    channel, float32 (records, samples): Recordings in volts.
    peak_v, float32 (records,): Largest magnitude of each recording in volts.
    place, int64 (records,): Where that is.
    range_v: End of the converter's range in volts, > 0.

    Returns int32 (records,).
    """
    count = np.zeros(channel.shape[0], dtype=np.int32)
    for record, peak in enumerate(peak_v):
        if peak < LEAST_PEAK_SHARE * range_v:
            continue
        if peak >= CLIP_SHARE * range_v:
            count[record] = _beyond(channel[record], CLIP_SHARE * range_v)
            continue
        around = channel[record, max(0, place[record] - AROUND_SAMPLES) : place[record] + AROUND_SAMPLES]
        top = _beyond(around, CLIP_SHARE * float(peak))
        if top >= LEAST_FLAT and 4 * top > _beyond(around, BELOW_SHARE * float(peak)):
            count[record] = _beyond(channel[record], CLIP_SHARE * float(peak))
    return count


def _beyond(recording: NDArray[np.float32], level_v: float) -> int:
    """Samples of this magnitude or more; two comparisons cost a fifth of one array of magnitudes."""
    level = np.float32(level_v)
    return int(np.count_nonzero(recording >= level) + np.count_nonzero(recording <= -level))
