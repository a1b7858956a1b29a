"""Fit of a psychometric function with intervals of threshold and slope.

The log-likelihood of the answers is penalised by half the logarithm of the determinant of Fisher's information (Firth,
Biometrika 80 (1993), 27: Jeffreys' prior), so that estimates stay finite where all answers to the higher levels are
right and all others at chance. The lapse rate is fitted between 0 and `MAX_LAPSES` (Wichmann and Hill, Percept.
Psychophys. 63 (2001), 1293). An interval holds the values whose profile of the penalised likelihood is within half the
95 % quantile of chi-square of its peak (Heinze and Schemper, Stat. Med. 21 (2002), 2409).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import xlogy
from scipy.stats import chi2

from wavefocus.rendering.arrays import Float64Array
from wavefocus.trials.order import share_right

Interval = tuple[float | None, float | None]

MAX_LAPSES = 0.12
_LAPSES = np.linspace(0.0, MAX_LAPSES, 7)
_DROP = chi2.ppf(0.95, 1) / 2.0
# Points of the axes of a profile, threshold and slope, in the passes that narrow it to the interval: the first must see
# a threshold that a steep slope leaves hardly any room. Halvings to its lapse rates.
_PROFILE_POINTS, _HALVINGS = ((241, 61), (61, 61), (61, 61)), 16


@dataclass(frozen=True, slots=True)
class PsychometricFit:
    """A fitted psychometric function (`wavefocus.trials.order.share_right`).

    levels: Above 0, hardest first, with `right` of `of` answers each.
    guess: Held at this value; lapse: fitted.
    threshold: In the level's own unit: 10 to the power of the function's threshold.
    slope: Per decade; negative where the share falls with the level.
    threshold_interval, slope_interval: 95 %; None at an end that the answers leave open.
    deviance: Of the fit from the observed shares; deviance_p: its place among chi-square's.
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
) -> PsychometricFit:
    """Fit a psychometric function to right answers out of all at two or more different levels above 0.

    guess: Share of right answers where the stimulus is too weak, from 0, below 1.
    falling: Whether the share falls with the level, as where speed makes a task harder.

    Raises ValueError: levels are too few, not above 0, or not different.
    """
    x = np.log10(np.asarray(levels, np.float64))
    k, n = np.asarray(right, np.float64), np.asarray(of, np.float64)
    if len(x) < 2 or not np.all(np.isfinite(x)) or len(np.unique(x)) < len(x) or np.any(n < 1):
        raise ValueError("a psychometric function needs answers at two or more different levels above 0")
    sign = -1.0 if falling else 1.0
    order = np.argsort(sign * x)
    likelihood = _Likelihood(sign * x[order], k[order], n[order], guess)
    return likelihood.fit(tuple(float(levels[index]) for index in order), sign)


class _Likelihood:
    """Penalised likelihood of answers at levels x, over threshold, logarithm of the slope, and lapse rate."""

    def __init__(self, x: Float64Array, k: Float64Array, n: Float64Array, guess: float) -> None:
        self._x, self._k, self._n, self._guess = x, k, n, guess
        span, step = float(np.ptp(x)), float(np.diff(x).min())
        self._bounds = [
            (x[0] - 1.5 * span, x[-1] + 1.5 * span),
            (math.log(0.5 / span), math.log(20.0 / step)),
            (0.0, MAX_LAPSES),
        ]

    def fit(self, levels: tuple[float, ...], sign: float) -> PsychometricFit:
        axes = [np.linspace(*bounds, 241) for bounds in self._bounds[:2]]
        thresholds, log_slopes = np.meshgrid(*axes, indexing="ij")
        plain = np.stack([self._plain(thresholds, log_slopes, lapse) for lapse in _LAPSES]).max(axis=0)
        surface = plain + self._penalty(thresholds, log_slopes)
        start = [axis[at] for axis, at in zip(axes, np.unravel_index(surface.argmax(), surface.shape), strict=True)]
        found = minimize(self._loss, [*start, MAX_LAPSES / 2.0], method="L-BFGS-B", bounds=self._bounds)
        threshold, log_slope, lapse = (float(value) for value in found.x)
        at, steep = self._intervals(found.x[:2], -float(found.fun))
        own = float(self._plain(np.array(threshold), np.array(log_slope), lapse))
        saturated = float((xlogy(self._k, self._k / self._n) + xlogy(self._n - self._k, 1.0 - self._k / self._n)).sum())
        deviance = 2.0 * (saturated - own)
        right, of = (tuple(int(count) for count in some) for some in (self._k, self._n))
        return PsychometricFit(
            levels, right, of, self._guess, lapse, 10.0 ** (sign * threshold),
            _mapped(at, sign, lambda value: 10.0 ** (sign * value)), sign * math.exp(log_slope),
            _mapped(steep, sign, lambda value: sign * math.exp(value)),
            deviance, float(chi2.sf(deviance, max(len(self._x) - 2, 1))), steep[1] is not None,
        )  # fmt: skip

    def _intervals(self, best: Float64Array, peak: float) -> tuple[Interval, Interval]:
        """Spans of threshold and logarithm of the slope whose profile is near the peak, which lies at `best`."""
        spans = self._bounds[:2]
        for points in _PROFILE_POINTS:
            axes = [np.union1d(np.linspace(*spans[number], points[number]), best[number]) for number in (0, 1)]
            grid = np.meshgrid(*axes, indexing="ij")
            bare = self._profile(*grid)
            surface = bare + self._penalty(*grid)
            peak = max(peak, float(surface.max()))
            drops = [peak - surface.max(axis=other) for other in (1, 0)]
            bare_drops = [bare.max() - bare.max(axis=other) for other in (1, 0)]
            inside = [np.flatnonzero(np.minimum(*both) <= _DROP) for both in zip(drops, bare_drops, strict=True)]
            spans = [
                (axis[max(near[0] - 2, 0)], axis[min(near[-1] + 2, len(axis) - 1)])
                for axis, near in zip(axes, inside, strict=True)
            ]
        # Steeper slopes than the levels resolve: the penalty excludes them whatever the answers, so it does not count.
        slope_drop = np.where(axes[1] > best[1], np.minimum(drops[1], bare_drops[1]), drops[1])
        return _within(axes[0], drops[0]), _within(axes[1], slope_drop)

    def _loss(self, point: Float64Array) -> float:
        threshold, log_slope, lapse = point
        return -float(self._plain(threshold, log_slope, lapse) + self._penalty(threshold, log_slope))

    def _profile(self, threshold: Float64Array, log_slope: Float64Array) -> Float64Array:
        """Largest log-likelihood over the lapse rates, which is concave in them: its derivative is bisected."""
        x, k, n = (row.reshape(-1, 1, 1) for row in (self._x, self._k, self._n))
        logistic = share_right(x, threshold, np.exp(log_slope), 0.0, 0.0)
        low, high = np.zeros(threshold.shape), np.full(threshold.shape, MAX_LAPSES)
        for _ in range(_HALVINGS):
            lapse = 0.5 * (low + high)
            share = np.clip(self._guess + (1.0 - self._guess - lapse) * logistic, 1e-12, 1.0 - 1e-12)
            falls = (logistic * (k / share - (n - k) / (1.0 - share))).sum(axis=0) > 0
            low, high = np.where(falls, low, lapse), np.where(falls, lapse, high)
        return self._plain(threshold, log_slope, low)

    def _plain(self, threshold: Float64Array, log_slope: Float64Array, lapse: float | Float64Array) -> Float64Array:
        """Log-likelihood at thresholds and slopes of any shape."""
        total = np.zeros(np.shape(threshold))
        for x, k, n in zip(self._x, self._k, self._n, strict=True):
            share = np.clip(share_right(x, threshold, np.exp(log_slope), self._guess, lapse), 1e-12, 1.0 - 1e-12)
            total = total + k * np.log(share) + (n - k) * np.log1p(-share)
        return np.asarray(total)

    def _penalty(self, threshold: Float64Array, log_slope: Float64Array) -> Float64Array:
        """Half the logarithm of the determinant of Fisher's information about offset and factor of the exponent."""
        a = b = c = np.zeros(np.shape(threshold))
        for x, n in zip(self._x, self._n, strict=True):
            share = np.clip(share_right(x, threshold, np.exp(log_slope), self._guess, MAX_LAPSES / 2.0), 1e-12, 1.0)
            logistic = share_right(x, threshold, np.exp(log_slope), 0.0, 0.0)
            rise = (1.0 - self._guess - MAX_LAPSES / 2.0) * logistic * (1.0 - logistic)
            weight, distance = n * rise**2 / (share * (1.0 - share)), x - threshold
            a, b, c = a + weight, b + weight * distance, c + weight * distance**2
        return np.asarray(0.5 * np.log(np.maximum(a * c - b * b, 1e-100)))


def _within(values: Float64Array, drop: Float64Array) -> Interval:
    """Ends of the span in which a profile stays within `_DROP` of its peak; None where it has no end."""
    inside = np.flatnonzero(drop <= _DROP)
    ends = [(inside[0], inside[0] - 1), (inside[-1], inside[-1] + 1)]
    found = [
        float(np.interp(_DROP, drop[[last, beyond]], values[[last, beyond]])) if 0 <= beyond < len(values) else None
        for last, beyond in ends
    ]
    return found[0], found[1]


def _mapped(interval: Interval, sign: float, to: Callable[[float], float]) -> Interval:
    low, high = (None if end is None else to(end) for end in interval)
    return (low, high) if sign > 0 else (high, low)
