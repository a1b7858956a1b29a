"""The best plain peers: NumPy and SciPy in float64, adjacent work that uses the same row merged.

At 4 mm and 10 cm/s some twenty path points in a row use the same row of the bank, so that a peer which convolves point
by point does twenty times the work. These do one convolution per run of equal rows, and transform a drive once.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.signal import oaconvolve, resample_poly

from wavefocus.benchmarks.render_workloads import ACTUATORS, RATE_HZ, TAPS, RenderWorkload, normalised_green
from wavefocus.rendering.greens.interpolation.on_grid import Bilinear
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.greens.source import GreenArray

Float64Array = NDArray[np.float64]
# A run of the source that one row emits: the row, its first sample, its samples.
Run = tuple[int, int, Float64Array]


def sampled_runs(workload: RenderWorkload) -> Iterator[Run]:
    """Runs of a sampled path: adjacent segments with the same row are one."""
    instants, rows, signal = workload.segments()
    edges = np.concatenate([[0], np.flatnonzero(np.diff(rows)) + 1, [len(rows)]])
    for first, end in pairwise(edges):
        row = int(rows[first])
        emitted = signal[instants[first] : instants[end]]
        yield row, int(instants[first]), emitted * normalised_green(workload.bank, row)[1]


def bilinear_runs(workload: RenderWorkload, samples: int) -> Iterator[Run]:
    """Runs of the exact moving source: of each row, the stretches in which bilinear interpolation uses it."""
    source, bank = workload.source, workload.bank
    along_mm = np.minimum(source.speed_mm_s * np.arange(samples) / RATE_HZ, source.path.length_mm)
    nodes = Bilinear(PositionGrid(bank.position_mm)).nodes(source.path.point_at(along_mm))
    gains = {int(row): normalised_green(bank, int(row))[1] for row in np.unique(nodes.nearest)}
    emitted = source.signal.samples(RATE_HZ)[:samples] * np.array([gains[int(row)] for row in nodes.nearest])
    for row in np.unique(nodes.rows).tolist():
        weights = np.where(nodes.rows == row, nodes.weights, 0.0).sum(axis=1)
        edges = np.flatnonzero(np.diff(weights != 0, prepend=False, append=False))
        for first, end in edges.reshape(-1, 2):
            yield row, int(first), weights[first:end] * emitted[first:end]


def render_merged(bank: GreenArray, runs: Iterator[Run], samples: int) -> Float64Array:
    """Drives of a source: one convolution per run, overlap-added."""
    drive = np.zeros((ACTUATORS, samples + TAPS - 1))
    for row, first, emitted in runs:
        made = _convolved(emitted, bank.values[row, :, ::-1].astype(np.float64))
        drive[:, first : first + made.shape[1]] += made
    return drive


def _convolved(signal: Float64Array, filters: Float64Array) -> Float64Array:
    """A signal by every filter: by one transform where it is short, else by SciPy's overlap-add."""
    length = len(signal) + filters.shape[1] - 1
    if length > 4 * filters.shape[1]:
        return np.asarray(oaconvolve(signal[np.newaxis], filters, axes=1))
    size = scipy.fft.next_fast_len(length, real=True)
    spectra = scipy.fft.rfft(filters, size, workers=2) * scipy.fft.rfft(signal, size)
    return np.asarray(scipy.fft.irfft(spectra, size, workers=2)[:, :length])


def predict_merged(greens: Sequence[NDArray[np.floating]], drive_v: Float64Array) -> Float64Array:
    """Field of a drive at rows (actuators, taps): its blocks transformed once, one inverse transform per position."""
    taps, length = greens[0].shape[1], drive_v.shape[1]
    size = scipy.fft.next_fast_len(4 * taps, real=True)
    step = size - taps + 1
    blocks = -(-length // step)
    padded = np.pad(drive_v, ((0, 0), (0, blocks * step - length))).reshape(len(drive_v), blocks, step)
    drives = scipy.fft.rfft(padded, size, workers=2).transpose(2, 1, 0).copy()  # (bin, block, actuator)
    field = np.zeros((len(greens), blocks * step + taps - 1))
    for position, green in enumerate(greens):
        spectra = scipy.fft.rfft(green.astype(np.float64), size, workers=2).T[:, :, np.newaxis]
        made = scipy.fft.irfft(np.matmul(drives, spectra)[:, :, 0].T, size, workers=2)
        for block, part in enumerate(made):
            field[position, block * step : block * step + size] += part
    return field[:, : length + taps - 1]


def decimated(signals: NDArray[np.floating], factor: int) -> Float64Array:
    """Signals at a lower rate. A filter is then to be multiplied by the factor, for its taps are further apart."""
    return np.asarray(resample_poly(signals.astype(np.float64), 1, factor, axis=-1))
