"""Blocks of drives, each computed anew from what sources emit, as far as it is certain or predicted now.

A drive sample n is made of the source samples n to n + L - 1, L the bank's taps (eq. 9, with p(s) the place of the
source at sample s):

    f_i[n] = sum_s u[s] g_i(p(s))[s - n]

Every block is computed anew from the courses of all sources as they are known or predicted now, for two blocks of
drives at once; the second half is crossfaded with the first half of the next computation, so that a prediction that
did not come true makes no click. Where nothing changed, both are the same numbers.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from rendering.arrays import BoolArray, Float64Array, Int64Array
from rendering.band import norm_of, scale
from rendering.device import fast_length
from rendering.drive.windows import Events, Windows
from rendering.greens.regularisation import BankRows
from rendering.live.row_stack import RowStack


class CrossfadedBlocks:
    """Blocks of drives, one after the other.

    rows: Rows of the bank, and how they are regularised.
    block_samples: Samples of a block, B.
    """

    window_samples: int
    """Source samples that a block is made of, from its own first sample on: L - 1 + 2 B."""

    def __init__(self, rows: BankRows, block_samples: int) -> None:
        self._rows, self._block_samples, self._lead = rows, block_samples, rows.bank.taps - 1
        self.window_samples = self._lead + 2 * block_samples
        self._fft_samples = fast_length(self.window_samples)
        self.stack = RowStack(rows, self._fft_samples)
        self._exponent: int | None = None
        self._rise = (np.arange(block_samples) + 0.5) / block_samples
        self._second_half: Float64Array = np.zeros((rows.bank.actuators, block_samples))
        self._blocks_per_second = max(1, round(float(rows.bank.sample_rate_hz) / block_samples))
        self._norms: deque[float] = deque(maxlen=self._blocks_per_second)
        """Norms of the blocks of the last second, in volts."""

    def next(self, events: Events | None, bound_db: float | None = None) -> Float64Array:
        """Compute a block, (actuators, block_samples), in volts; infinite or NaN where it does not fit into float64.

        events: What is emitted at `window_samples`, counted from the block's first sample.
        bound_db: Allows leaving out bins from the highest downwards, as far as the norm of what is missing is proved to
            be at most the bound times R, the root mean square of the norms of the blocks given in the second before.
            Each block counts in one second's worth of R, and a crossfade does not enlarge the sum of the squares of
            both errors, so that the error of all drives in L2 is at most the bound times their norm, beside rounding.
        """
        computed = np.zeros((self._rows.bank.actuators, 2 * self._block_samples))
        if events is not None and events.values.any():
            computed = self._computed(events, bound_db)
        block = computed[:, : self._block_samples] * self._rise
        block += self._second_half * (1.0 - self._rise)
        self._norms.append(norm_of(block))
        self._second_half = computed[:, self._block_samples :]
        return np.asarray(block)

    def _computed(self, events: Events, bound_db: float | None) -> Float64Array:
        """Drives of two blocks, (actuators, 2 B)."""
        windows = Windows(events)
        if self._exponent is None:
            rows, by = windows.pairs
            self._exponent = int(np.frexp(self._rows.weigh(rows[:1], by[:1])[0][0])[1])
        windows.weigh(self._weigh)
        unit = self._exponent + self._rows.drive_exponent
        emitted = windows.spectra(0, len(windows), self._fft_samples)
        total = self.stack.total(windows, emitted, 0.0 if bound_db is None else self._error(bound_db, unit))
        samples = np.fft.irfft(total.T, n=self._fft_samples, axis=1)[:, self._lead : self.window_samples]
        return scale(samples, unit)

    def _weigh(self, rows: Int64Array, regularised_by: Int64Array) -> tuple[Float64Array, BoolArray]:
        return self._rows.weigh(rows, regularised_by, self._exponent or 0)

    def _error(self, bound_db: float, unit: int) -> float:
        """Norm that may be left out, over 2**unit volts."""
        level_v = norm_of(np.array([*self._norms, 0.0])) / math.sqrt(self._blocks_per_second)
        with np.errstate(over="ignore", under="ignore"):
            error = float(np.ldexp(10.0 ** (bound_db / 20.0) * level_v, -unit))
        return error if math.isfinite(error) else 0.0
