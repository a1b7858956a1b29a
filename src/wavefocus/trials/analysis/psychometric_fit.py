"""Fit of a psychometric function with intervals of threshold and slope.

The log-likelihood of the answers is penalised by half the logarithm of the determinant of Fisher's information (Firth,
Biometrika 80 (1993), 27: Jeffreys' prior), so that estimates stay finite where all answers to the higher levels are
right and all others at chance, and are less biased after few trials. The lapse rate is fitted between 0 and
`MAX_LAPSES` (as Wichmann and Hill do, Percept. Psychophys. 63 (2001), 1293, up to 0.06).

An interval holds the values whose profile of the penalised likelihood is high enough (Heinze and Schemper, Stat. Med.
21 (2002), 2409). A parametric bootstrap sets the limit: participants with the fitted function answer at the same
levels, and in 95 % of them the profile at that function's value is within the limit (Davison and Hinkley, Bootstrap
Methods, 1997, section 4.4). The limit is no less than that of large samples, 3.84 / 2.

The penalty excludes slopes that are steep for the levels, whatever the answers: where they pass from chance to right
between two levels, every steeper function is as likely. Towards steeper slopes an interval therefore also holds what
the likelihood without its penalty does not exclude.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavefocus.trials.psychometric import share_right

Float64Array = NDArray[np.float64]
Interval = tuple[float | None, float | None]

# Beyond the 0.06 that Wichmann and Hill propose: with a true rate of 0.1 the slope's interval then held the truth in
# 95 of 100 simulated participants in place of 85, and as often as before with lower rates.
MAX_LAPSES = 0.12
_LAPSES = np.linspace(0.0, MAX_LAPSES, 5)
_REFERENCE_LAPSES = MAX_LAPSES / 2.0
"""Lapse rate of the information in the penalty, so that the penalty does not choose the lapse rate."""
_CHI2_95 = 3.841458820694124
"""95 % quantile of chi-square with one degree of freedom."""
# Offsets of grids around the estimate in standard errors, denser near it.
_OFFSETS = np.sinh(np.linspace(-4.6, 4.6, 129))
_BOOTSTRAP_OFFSETS = np.sinh(np.linspace(-2.8, 2.8, 37))


@dataclass(frozen=True, slots=True)
class PsychometricFit:
    """A fitted psychometric function (`wavefocus.trials.psychometric.share_right`).

    levels: Above 0, hardest first, with `right` of `of` answers each.
    guess: Held at this value; lapse: fitted.
    threshold: In the level's own unit: 10 to the power of the function's threshold.
    slope: Per decade; negative where the share falls with the level.
    threshold_interval, slope_interval: 95 %; None at an end that the answers leave open.
    deviance: Of the fit from the observed shares; deviance_p: share of bootstrap replicates whose deviance is no less.
    slope_resolved: Whether the answers exclude a step between two levels; where they do not, the slope is no more than
        a lower bound.
    """

    levels: tuple[float, ...]
    right: tuple[int, ...]
    of: tuple[int, ...]
    guess: float
    lapse: float
    threshold: float
    threshold_interval: Interval
    slope: float
    slope_interval: Interval
    deviance: float
    deviance_p: float
    slope_resolved: bool

    def share(self, level: float | Float64Array) -> Float64Array:
        """Fitted share of right answers at levels above 0."""
        return share_right(np.log10(level), math.log10(self.threshold), self.slope, self.guess, self.lapse)


def fit_psychometric(
    levels: Sequence[float],
    right: Sequence[int],
    of: Sequence[int],
    *,
    guess: float,
    falling: bool = False,
    replicates: int = 999,
) -> PsychometricFit:
    """Fit a psychometric function to right answers out of all at two or more different levels above 0.

    guess: Share of right answers where the stimulus is too weak, from 0, below 1.
    falling: Whether the share falls with the level, as where speed makes a task harder.
    replicates: Of the bootstrap, with a generator of fixed seed.

    Raises ValueError: levels are too few, not above 0, or not different.
    """
    x = np.log10(np.asarray(levels, np.float64))
    k, n = np.asarray(right, np.float64), np.asarray(of, np.float64)
    if len(x) < 2 or not np.all(np.isfinite(x)) or len(np.unique(x)) < len(x) or np.any(n < 1):
        raise ValueError("a psychometric function needs answers at two or more different levels above 0")
    sign = -1.0 if falling else 1.0
    order = np.argsort(sign * x)
    likelihood = _Likelihood(sign * x[order], k[order], n[order], guess)
    return likelihood.fit(tuple(float(levels[index]) for index in order), sign, replicates)


class _Likelihood:
    """Penalised likelihood of answers at levels x, on grids of threshold, logarithm of the slope, and lapse rate."""

    def __init__(self, x: Float64Array, k: Float64Array, n: Float64Array, guess: float) -> None:
        self._x, self._k, self._n, self._guess = x, k, n, guess
        span, step = float(np.ptp(x)), float(np.diff(x).min())
        self._thresholds = (x[0] - 1.5 * span, x[-1] + 1.5 * span)
        self._log_slopes = (math.log(0.5 / span), math.log(20.0 / step))

    def fit(self, levels: tuple[float, ...], sign: float, replicates: int) -> PsychometricFit:
        threshold, log_slope, lapse = self._best()
        grid = self._around(threshold, log_slope, lapse, _OFFSETS)
        bare = np.stack([self._plain(self._k, grid[0], grid[1], lapse_rate) for lapse_rate in grid[2]], axis=-1).max(
            axis=-1
        )
        surface = bare + self._penalty(grid[0], grid[1])
        peak = float(self._penalised(self._k, *(np.array([value]) for value in (threshold, log_slope, lapse))).item())
        limits, deviance, deviance_p = self._bootstrap(threshold, log_slope, lapse, replicates)
        slope_drop = peak - surface.max(axis=0)
        bare_drop = bare.max() - bare.max(axis=0)
        slope_drop = np.where(grid[1] > log_slope, np.minimum(slope_drop, bare_drop), slope_drop)
        ends = [
            _interval(values, drop, limit, place)
            for values, drop, limit, place in (
                (grid[0], peak - surface.max(axis=1), limits[0], threshold),
                (grid[1], slope_drop, limits[1], log_slope),
            )
        ]
        resolved = bool(bare.max() - self._step() > limits[1])
        if not resolved:
            ends[1] = (ends[1][0], None)
        threshold_interval = _mapped(ends[0], sign, lambda value: 10.0 ** (sign * value))
        slope_interval = _mapped(ends[1], sign, lambda value: sign * math.exp(value))
        right, of = (tuple(int(count) for count in some) for some in (self._k, self._n))
        return PsychometricFit(
            levels, right, of, self._guess, lapse, 10.0 ** (sign * threshold), threshold_interval,
            sign * math.exp(log_slope), slope_interval, deviance, deviance_p, resolved,
        )  # fmt: skip

    def _step(self) -> float:
        """The largest log-likelihood of the steepest function, wherever its threshold."""
        thresholds, steepest = np.linspace(self._x[0], self._x[-1], 20 * len(self._x)), np.array([self._log_slopes[1]])
        return max(float(self._plain(self._k, thresholds, steepest, lapse).max()) for lapse in _LAPSES)

    def _best(self) -> tuple[float, float, float]:
        """The largest penalised likelihood within bounds: a grid, then a descent."""
        from scipy.optimize import minimize

        bounds = [self._thresholds, self._log_slopes, (0.0, MAX_LAPSES)]
        grid = (np.linspace(*self._thresholds, 81), np.linspace(*self._log_slopes, 41), _LAPSES)
        surface = self._penalised(self._k, *grid)
        start = [
            axis[place] for axis, place in zip(grid, np.unravel_index(surface.argmax(), surface.shape), strict=True)
        ]

        def loss(point: Float64Array) -> float:
            return -float(self._penalised(self._k, *(point[axis : axis + 1] for axis in range(3))).item())

        found = minimize(loss, start, method="L-BFGS-B", bounds=bounds)
        threshold, log_slope, lapse = (
            float(value) for value in (found.x if found.fun <= loss(np.array(start)) else start)
        )
        return threshold, log_slope, lapse

    def _around(
        self, threshold: float, log_slope: float, lapse: float, offsets: Float64Array
    ) -> tuple[Float64Array, Float64Array, Float64Array]:
        """A grid about an estimate, in its standard errors, cut at the bounds; the estimate's lapse rate is in it."""
        a, b, c = (
            float(entry.item()) for entry in self._information(np.array([threshold]), np.array([log_slope]), lapse)
        )
        slope = math.exp(log_slope)
        # Of threshold and log slope, from the information about the exponent's offset and factor.
        determinant = max(a * c - b * b, 1e-12)
        threshold_error = math.sqrt(c / determinant) / slope
        slope_error = math.sqrt(a / determinant) / slope
        low, high = self._thresholds
        thresholds = np.clip(threshold + min(threshold_error, (high - low) / 8.0) * offsets, low, high)
        log_slopes = np.clip(log_slope + min(slope_error, 1.0) * offsets, *self._log_slopes)
        return np.unique(thresholds), np.unique(log_slopes), np.union1d(_LAPSES, lapse)

    def _bootstrap(
        self, threshold: float, log_slope: float, lapse: float, replicates: int
    ) -> tuple[tuple[float, float], float, float]:
        """Drops of the profiles that 95 % of replicates stay within; the deviance, and its place among theirs."""
        grid = self._around(threshold, log_slope, lapse, _BOOTSTRAP_OFFSETS)
        share = share_right(self._x, threshold, math.exp(log_slope), self._guess, lapse)
        drawn = np.random.default_rng(1).binomial(self._n.astype(np.int64), share, (replicates, len(share)))
        k = drawn.astype(np.float64)
        shape = (replicates, len(grid[0]), len(grid[1]))
        profile, best = np.full(shape, -np.inf), np.full(replicates, -np.inf)
        bare = np.zeros(replicates)
        penalty = self._penalty(grid[0], grid[1])
        for lapse_rate in grid[2]:
            plain = self._plain(k, grid[0], grid[1], lapse_rate)
            penalised = plain + penalty
            place = penalised.reshape(replicates, -1).argmax(axis=1)
            top = np.take_along_axis(penalised.reshape(replicates, -1), place[:, None], 1)[:, 0]
            better = top > best
            bare[better] = np.take_along_axis(plain.reshape(replicates, -1), place[:, None], 1)[better, 0]
            best = np.maximum(best, top)
            np.maximum(profile, penalised, out=profile)
        row, column = int(np.argmin(abs(grid[0] - threshold))), int(np.argmin(abs(grid[1] - log_slope)))
        drops = (best - profile[:, row].max(axis=1), best - profile[:, :, column].max(axis=1))
        limits = [max(float(np.quantile(drop, 0.95)), _CHI2_95 / 2.0) for drop in drops]
        own = float(self._plain(self._k, np.array([threshold]), np.array([log_slope]), lapse).item())
        deviance = 2.0 * (float(self._saturated(self._k)) - own)
        larger = np.count_nonzero(2.0 * (self._saturated(k) - bare) >= deviance)
        return (limits[0], limits[1]), deviance, (1 + int(larger)) / (1 + replicates)

    def _shares(self, thresholds: Float64Array, log_slopes: Float64Array, lapse: float) -> Float64Array:
        """Shares of right answers (level, threshold, slope), kept off 0 and 1."""
        x = self._x[:, None, None]
        shares = share_right(x, thresholds[:, None], np.exp(log_slopes), self._guess, lapse)
        return np.clip(shares, 1e-12, 1.0 - 1e-12)

    def _plain(self, k: Float64Array, thresholds: Float64Array, log_slopes: Float64Array, lapse: float) -> Float64Array:
        """Log-likelihoods (..., threshold, slope) of right answers k (..., level)."""
        shares = self._shares(thresholds, log_slopes, lapse).reshape(len(self._x), -1)
        logs = k @ np.log(shares) + (self._n - k) @ np.log1p(-shares)
        return np.asarray(logs).reshape(*k.shape[:-1], len(thresholds), len(log_slopes))

    def _information(
        self, thresholds: Float64Array, log_slopes: Float64Array, lapse: float
    ) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Fisher's information about offset and factor of the exponent, the offset at the threshold: a, b; b, c."""
        shares = self._shares(thresholds, log_slopes, lapse)
        distance = self._x[:, None, None] - thresholds[:, None]
        logistic = share_right(self._x[:, None, None], thresholds[:, None], np.exp(log_slopes), 0.0, 0.0)
        rise = (1.0 - self._guess - lapse) * logistic * (1.0 - logistic)
        weights = self._n[:, None, None] * rise**2 / (shares * (1.0 - shares))
        return weights.sum(axis=0), (weights * distance).sum(axis=0), (weights * distance**2).sum(axis=0)

    def _penalty(self, thresholds: Float64Array, log_slopes: Float64Array) -> Float64Array:
        a, b, c = self._information(thresholds, log_slopes, _REFERENCE_LAPSES)
        return 0.5 * np.log(np.maximum(a * c - b * b, 1e-100))

    def _penalised(
        self, k: Float64Array, thresholds: Float64Array, log_slopes: Float64Array, lapses: Float64Array
    ) -> Float64Array:
        """Penalised log-likelihoods (threshold, slope, lapse)."""
        plain = np.stack([self._plain(k, thresholds, log_slopes, lapse_rate) for lapse_rate in lapses], axis=-1)
        return plain + self._penalty(thresholds, log_slopes)[..., None]

    def _saturated(self, k: Float64Array) -> Float64Array:
        """Log-likelihood of the observed shares."""
        from scipy.special import xlogy

        total: Float64Array = (xlogy(k, k / self._n) + xlogy(self._n - k, 1.0 - k / self._n)).sum(axis=-1)
        return total


def _interval(values: Float64Array, drop: Float64Array, limit: float, place: float) -> Interval:
    """Where a profile's drop from its peak passes the limit on both sides; its root is nearly linear there."""
    root = np.sqrt(np.maximum(drop, 0.0))
    ends: list[float | None] = []
    for side in (values[::-1][values[::-1] < place], values[values > place]):
        heights = root[np.searchsorted(values, side)]
        beyond = np.flatnonzero(heights > math.sqrt(limit))
        if len(beyond) == 0:
            ends.append(None)
            continue
        last = beyond[0]
        inner, low = (place, 0.0) if last == 0 else (float(side[last - 1]), float(heights[last - 1]))
        ends.append(inner + (float(side[last]) - inner) * (math.sqrt(limit) - low) / (float(heights[last]) - low))
    return ends[0], ends[1]


def _mapped(interval: Interval, sign: float, to: Callable[[float], float]) -> Interval:
    low, high = (None if end is None else to(end) for end in interval)
    return (low, high) if sign > 0 else (high, low)
