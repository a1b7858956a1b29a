"""Blocks of drives, computed anew from what sources emit, as far as it is certain or predicted now.

A drive sample n is made of the source samples n to n + L - 1, L the bank's taps (eq. 9, with p(s) the place of the
source at sample s):

    f_i[n] = sum_s u[s] g_i(p(s))[s - n]

Three blocks are computed at once from the courses of all sources as they are known or predicted now. Where an order
changes a course the next block is computed anew, and crossfaded with what the computation before gave for it, so that a
prediction that did not come true makes no click. Where nothing changes, both are the same numbers, and the second block
is taken as it is.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from wavefocus.rendering.arrays import Complex128Array, Float64Array
from wavefocus.rendering.band import Band, norm_of
from wavefocus.rendering.device import fast_length, host_device
from wavefocus.rendering.drive.windows import Events, RowSpectra, Windows
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.greens.source import apply_exponent

CACHE_BYTES = 2**30
"""Memory of row spectra: 1500 positions of 20 actuators and 2000 taps take half of it."""
AT_ONCE = 3
"""Blocks computed at once: the one that is due, one that stands where no order comes, and one to fade from."""


class CrossfadedBlocks:
    """Blocks of drives, one after the other.

    rows: Rows of the bank, and how they are regularised.
    block_samples: Samples of a block, B.
    """

    window_samples: int
    """Source samples that a computation takes, from the block's first sample on: L - 1 + 3 B."""

    def __init__(self, rows: BankRows, block_samples: int) -> None:
        self._rows, self._block_samples, self._lead = rows, block_samples, rows.bank.taps - 1
        self.window_samples = self._lead + AT_ONCE * block_samples
        self._fft_samples = fast_length(self.window_samples)
        device = replace(host_device(), memory_bytes=CACHE_BYTES)
        self._spectra = RowSpectra(rows, Band.whole(self._fft_samples), device, magnitudes=True)
        self._product = np.empty((rows.bank.actuators, self._spectra.band.bins), dtype=np.complex128)
        self._rise = (np.arange(block_samples) + 0.5) / block_samples
        self._ahead: Float64Array = np.zeros((rows.bank.actuators, block_samples))
        """What the last computation gave for the blocks to come."""
        self._blocks_per_second = max(1, round(float(rows.bank.sample_rate_hz) / block_samples))
        self._norms: deque[float] = deque(maxlen=self._blocks_per_second)
        """Norms of the blocks of the last second, in volts."""

    @property
    def most_rows(self) -> int:
        """Rows whose spectra are kept in memory."""
        return self._spectra.most_rows

    def load(self, row: int) -> None:
        """Read and transform a row. Raises InputError: it may not be used."""
        self._spectra.load([row])

    def next(self, events: Events | None, bound_db: float | None = None) -> Float64Array:
        """Compute a block, (actuators, block_samples), in volts; infinite or NaN where it does not fit into float64.

        events: What is emitted at `window_samples`, counted from the block's first sample.
        bound_db: Allows leaving out bins from the highest downwards, as far as the norm of what is missing is proved to
            be at most the bound times R, the root mean square of the norms of the blocks given in the second before.
            Each computation errs by at most its bound over all of its blocks, each block counts in one second's worth
            of R, and a crossfade does not enlarge the sum of the squares of both errors, so that the error of all
            drives in L2 is at most the bound times their norm, beside rounding.
        """
        size = self._block_samples
        computed = np.zeros((self._rows.bank.actuators, AT_ONCE * size))
        if events is not None and events.values.any():
            computed = self._computed(events, bound_db)
        block = computed[:, :size] * self._rise
        block += self._ahead[:, :size] * (1.0 - self._rise)
        return self._given(block, computed[:, size:])

    def unchanged(self) -> Float64Array | None:
        """The next block where no course has changed since the last one; None where it is to be computed."""
        size = self._block_samples
        if self._ahead.shape[1] < 2 * size:
            return None
        return self._given(self._ahead[:, :size].copy(), self._ahead[:, size:])

    def _given(self, block: Float64Array, ahead: Float64Array) -> Float64Array:
        self._norms.append(norm_of(block))
        self._ahead = ahead
        return block

    def _computed(self, events: Events, bound_db: float | None) -> Float64Array:
        """Drives of three blocks, (actuators, 3 B)."""
        windows = Windows(events)
        windows.weigh(self._rows.weigh)
        unit = self._rows.drive_exponent
        emitted = windows.spectra(0, len(windows), self._fft_samples)
        error = 0.0 if bound_db is None else self._error(bound_db, unit)
        total = self._total(windows, emitted[:, : self._kept(windows, emitted, error)])
        samples = np.fft.irfft(total, n=self._fft_samples, axis=1)[:, self._lead : self.window_samples]
        return apply_exponent(samples, unit)

    def _total(self, windows: Windows, emitted: Complex128Array) -> Complex128Array:
        """Sum of windows times time-reversed rows, (actuators, kept bins)."""
        kept = emitted.shape[1]
        total, product = np.zeros_like(self._product[:, :kept]), self._product[:, :kept]
        for row, by, window in zip(windows.rows.tolist(), windows.regularised_by.tolist(), emitted, strict=True):
            self.load(row)
            np.multiply(self._spectra[row].values[:, :kept], window, out=product)
            sigma = self._rows.sigma(by) if by >= 0 else None
            if sigma is not None:
                product *= sigma[:, None]
            total += product
        return total

    def _kept(self, windows: Windows, emitted: Complex128Array, error: float) -> int:
        """Number of bins; the norm in time of those beyond is at most the error (see `wavefocus.rendering.band`)."""
        bins: int = emitted.shape[1]
        if not error > 0:
            return bins
        summed = np.zeros(bins)
        for row, size in zip(windows.rows.tolist(), np.abs(emitted), strict=True):
            self.load(row)
            # Saturation only lessens a row.
            summed += size * self._spectra[row].magnitude
        beyond = np.cumsum(np.square(summed[::-1])) * (2.0 / self._fft_samples)
        return max(bins - int(np.searchsorted(beyond, error**2, side="right")), 1)

    def _error(self, bound_db: float, unit: int) -> float:
        """Norm that may be left out, over 2**unit volts."""
        level_v = norm_of(np.array([*self._norms, 0.0])) / math.sqrt(self._blocks_per_second)
        with np.errstate(over="ignore", under="ignore"):
            error = float(np.ldexp(10.0 ** (bound_db / 20.0) * level_v, -unit))
        return error if math.isfinite(error) else 0.0
