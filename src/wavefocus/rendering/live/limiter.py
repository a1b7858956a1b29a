"""Limits of live drives at the interface's rate: one gain for all outputs, found a look-ahead before it is due."""

import math
from itertools import accumulate

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.drive.coil_limits import RMS_WINDOW_S, DriveLimits, require_finite

LOOK_AHEAD_S = 0.0025
"""Half a period at 200 Hz, in the middle of what skin feels best."""
RELEASE_S = 0.2
"""Time in which a gain of nearly 0 goes back to 1."""
LEAK_S = 0.25
"""Time constant of the rms: what lasts is held 1 dB below the limit, and a fifth of a second's energy may come at once.
A longer one lets through longer bursts and holds what lasts further below."""
_ROUNDING = 1.0 - 1e-12


class LiveLimiter:
    """Holds the peak and the rms over any second of every channel, at every sample, with one gain for all channels.

    limits: Largest magnitude and rms in volts; None: no such limit.
    full_scale_v, float64 (channels,): Volts at full scale of each output, a limit of its magnitude.
    rate_hz: Rate of the blocks, the interface's.
    look_ahead_frames: Delay of what comes out, >= 1; the gain falls within about half of it. By default `LOOK_AHEAD_S`.

    Peak. r[n] is the largest gain, at most 1, that keeps sample n of all channels within their limits; after a fall it
    rises by at most 1 / (`RELEASE_S` rate) per sample. The gain is the mean of m[n - D .. n], where
    m[k] = min r[k .. k + D]: each of these minima has r[n] among its values, so none is above r[n], nor is their mean.

    RMS. Samples, already with r[n], go in chunks of K; e_j is a chunk's energy. A second gain r_j, with the same
    release, is chosen so that P_j = q P_(j-1) + r_j**2 e_j <= C for every channel, with q = exp(-K / (`LEAK_S` rate)).
    Then r[n] r_j takes the place of r[n] above. A second, W samples, touches at most M = ceil((W - 1) / K) + 1 chunks,
    and their energy is at most sum(P_j - q P_(j-1)) <= C (1 + (M - 1)(1 - q)), which is W times the limit squared by
    the choice of C. What lasts reaches sqrt(W / (W + `LEAK_S` rate)) of the limit, -1 dB.

    Where neither binds all of these numbers are 1, and their products and means are 1 exactly.
    """

    def __init__(
        self, limits: DriveLimits, full_scale_v: Float64Array, rate_hz: int, look_ahead_frames: int | None = None
    ) -> None:
        self.rate_hz = rate_hz
        self.look_ahead_frames = look_ahead_frames or max(1, round(LOOK_AHEAD_S * rate_hz))
        self._peak_v = np.minimum(full_scale_v, math.inf if limits.peak_v is None else limits.peak_v)[:, None]
        self._rms_v = math.inf if limits.rms_v is None else limits.rms_v
        self._release = 1.0 / (RELEASE_S * rate_hz)
        self._chunk = max(1, self.look_ahead_frames // 2)
        self._reach = self.look_ahead_frames + 1 - self._chunk
        self._leak = math.exp(-self._chunk / (LEAK_S * rate_hz))
        window = max(1, round(RMS_WINDOW_S * rate_hz))
        self._most = window / (1.0 + math.ceil((window - 1) / self._chunk) * (1.0 - self._leak))
        self._peak_gain, self._chunk_gain = 1.0, 1.0
        self._energy: Float64Array = np.zeros(len(full_scale_v))
        # Samples that wait; r r_j from `reach` before the first of them; r of those beyond the last whole chunk.
        self._waiting: Float64Array = np.zeros((len(full_scale_v), self.look_ahead_frames))
        self._gains: Float64Array = np.ones(self.look_ahead_frames + self._reach)
        self._unchunked: Float64Array = np.ones(0)
        self.gain_db = 0.0
        """Least gain of the last block that came out, 0 where nothing was limited."""

    def limit(self, block: Float64Array) -> Float64Array:
        """Take the next block (channels, frames), any number of them; give as many, of `look_ahead_frames` before.

        Raises InputError: the block holds NaN or infinity.
        """
        require_finite(block)
        frames = block.shape[1]
        self._waiting = np.concatenate([self._waiting, block], axis=1)
        self._unchunked = np.concatenate([self._unchunked, self._peak_gains(block)])
        whole = len(self._unchunked) // self._chunk * self._chunk
        new = self._unchunked[:whole]
        if whole and math.isfinite(self._rms_v):
            first = self._waiting.shape[1] - len(self._unchunked)
            new = new * self._rms_gains(self._waiting[:, first : first + whole] * new)
        self._gains = np.concatenate([self._gains, new])
        self._unchunked = self._unchunked[whole:]
        if not frames:
            return np.empty_like(block)
        window, gains = self._reach + 1, self._gains[: frames + 2 * self._reach]
        limited: Float64Array = self._waiting[:, :frames]
        self.gain_db = 0.0
        if gains.min() < 1.0:
            gain = sliding_window_view(sliding_window_view(gains, window).min(axis=-1), window).mean(axis=-1)
            limited = limited * gain
            self.gain_db = 20.0 * math.log10(max(float(gain.min()), 1e-15))
        self._waiting, self._gains = self._waiting[:, frames:], self._gains[frames:]
        return limited

    def _peak_gains(self, block: Float64Array) -> Float64Array:
        """Gain r of each sample of a block, released after a fall."""
        if not block.shape[1]:
            return np.ones(0)
        with np.errstate(over="ignore", divide="ignore", under="ignore"):
            allowed = np.minimum(_ROUNDING / (np.abs(block) / self._peak_v).max(axis=0), 1.0)
        if self._peak_gain == 1.0 and (allowed == 1.0).all():
            return np.asarray(allowed)
        # One sample after another, so that a gain does not depend on where a block begins.
        step = self._release
        rising = accumulate(allowed.tolist(), lambda gain, most: min(most, gain + step), initial=self._peak_gain)
        gains = np.fromiter(rising, float, len(allowed) + 1)[1:]
        self._peak_gain = float(gains[-1])
        return gains

    def _rms_gains(self, samples: Float64Array) -> Float64Array:
        """Gains r_j of whole chunks of samples that are within the peak, one value per sample."""
        chunks = (samples / self._rms_v).reshape(len(samples), -1, self._chunk)
        gains = np.empty(chunks.shape[1])
        for index, energy in enumerate(np.square(chunks).sum(axis=2).T):
            self._energy *= self._leak
            gain = min(1.0, self._chunk_gain + self._chunk * self._release)
            beyond = self._energy + gain**2 * energy > _ROUNDING * self._most
            if beyond.any():
                room = np.maximum(_ROUNDING * self._most - self._energy[beyond], 0.0)
                gain = min(gain, float(np.sqrt((room / energy[beyond]).min())))
            self._energy += gain**2 * energy
            gains[index] = self._chunk_gain = gain
        return np.repeat(gains, self._chunk)
