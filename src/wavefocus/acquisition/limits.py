"""How far a sentinel position drifted, and what the limits of drift say of it."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from wavefocus.acquisition.plan import Plan, row_error_db
from wavefocus.calibration import Complex128Array, Float32Array, Float64Array
from wavefocus.calibration.estimator.noise_error import noise_share
from wavefocus.calibration.evidence import CLEAR_DB, ROW_CHANGE, SEEN_SHARE
from wavefocus.calibration.numerics import parabola_vertex
from wavefocus.config.run import DriftLimits

STEP_DB, STEP_SAMPLES = 0.5, 0.3
"""The smallest changes at once that must be seen: 6 % of a row, and 6 % at the upper end of the usual band. They set
the limit of the change between two looks; half of them would be near what a warming plate leaves after its part is
taken out (0.2 to 0.9 % of 1.5 %, on soft and solid plates), double would leave rows of 12 % error valid."""
GROUPS = 8
"""Parts of the band in which the drift has a coefficient each: dispersion changes little within them."""


class Look(NamedTuple):
    """One measurement of a position.

    green, float32 (actuators, taps): Green's functions.
    snr_db, float32 (actuators,): Signal-to-noise ratios of the records, NaN where unknown.
    """

    green: Float32Array
    snr_db: Float32Array


@dataclass(frozen=True, slots=True)
class DriftFigures:
    """How a re-measured sentinel differs from the first measurement, and from the latest good look.

    level_db: Energy now over energy then, in dB.
    delay_samples: Lag of the largest cross-correlation, refined by a parabola; positive when the response comes later
        now.
    correlation: Cross-correlation at that lag over the root of both energies, 0 to 1.
    noise_db: How far noise alone may move the level, in dB.
    change: Norm of the difference in band over that of the first measurement, noise taken out: what drift makes of a
        row that is measured now.
    step: Change since the latest good look over the smallest that is a step, see `step_of`; None where no look is
        compared.
    """

    level_db: float
    delay_samples: float
    correlation: float
    noise_db: float = 0.0
    change: float = float("nan")
    step: float | None = None

    def verdict(self, limits: DriftLimits) -> str:
        """``"steady"``, ``"warn"`` for a step, or ``"stop"``."""
        beyond = abs(self.level_db) > limits.stop_level_db + self.noise_db
        if beyond or abs(self.delay_samples) > limits.stop_delay_samples or self.correlation < limits.stop_correlation:
            return "stop"
        if self.step is not None:
            return "warn" if self.step > 1.0 else "steady"
        beyond = abs(self.level_db) > limits.warn_level_db + self.noise_db
        if beyond or abs(self.delay_samples) > limits.warn_delay_samples or self.correlation < limits.warn_correlation:
            return "warn"
        return "steady"

    def speaks_against(self, limits: DriftLimits) -> bool:
        """Whether what was measured since the last steady measurement has another scale, or is of another plate."""
        if self.step is not None:
            return self.verdict(limits) != "steady"
        return self.verdict(limits) == "stop" or abs(self.level_db) > limits.warn_level_db + self.noise_db

    def __str__(self) -> str:
        return (
            f"level {self.level_db:+.2f} dB, delay {self.delay_samples:+.2f} samples, "
            f"correlation {self.correlation:.3f}"
        )


def compare_looks(plan: Plan, position: int, first: Look, now: Look, good: Look | None = None) -> DriftFigures:
    """Figures of a position of a plan against its first look, with the step since a good one, by default the first."""
    sweep, since = plan.excitation, good or first

    def share(look: Look) -> Float64Array:
        return noise_share(row_error_db(plan, np.nan_to_num(look.snr_db, nan=200.0)))

    noise, distance_mm = share(now), np.hypot(*(plan.actuator_mm - plan.position_mm[position]).T)
    rate_hz, shares = sweep.sample_rate_hz, ((share(first), noise), (share(since), noise))
    figures = compare_sentinel(
        first.green, now.green, first.snr_db, shares[0], band_hz=sweep.band_hz, sample_rate_hz=rate_hz
    )
    step = step_of(since.green, now.green, shares[1], distance_mm, band_hz=sweep.band_hz, sample_rate_hz=rate_hz)
    return replace(figures, step=step)


def step_of(
    then: Float32Array,
    now: Float32Array,
    noise_share: tuple[Float64Array, Float64Array],
    distance_mm: Float64Array,
    *,
    band_hz: tuple[float, float],
    sample_rate_hz: float,
) -> float:
    """Change of a position's rows between two looks, over the smallest change at once that must be seen.

    Slow drift, of the room's temperature for one, changes each row by a factor that grows with the distance of its
    actuator: ``exp(c r)``, with one complex c for each part of the band. That part is taken out, and the norm of what
    is left is compared with what changes of `STEP_DB` (louder) and `STEP_SAMPLES` in all rows would leave, but for a
    fifth (`SEEN_SHARE`), and with the noise of both looks; with twice the noise at least. A single row is compared
    with half of itself.

    then, now, float32 (actuators, taps): Green's functions at the two looks.
    noise_share, float64 (actuators,): Share that noise has in the energy of each row, of either look.
    distance_mm, float64 (actuators,): From the actuators to the position; where one is NaN no drift is taken out.
    """
    taps = then.shape[1]
    hertz = np.fft.rfftfreq(2 * taps, 1 / sample_rate_hz)
    inside = (hertz >= band_hz[0]) & (hertz <= band_hz[1])
    first, second = (np.fft.rfft(green.astype(np.float64), 2 * taps, axis=1)[:, inside] for green in (then, now))
    known = bool(np.isfinite(distance_mm).all()) and len(then) > 2
    weights = distance_mm / np.mean(distance_mm) if known else np.zeros(len(then))
    # A fainter level leaves 6 % less than a louder one: above four fifths too. Of a delay both ways leave the same.
    late = np.exp(-2j * np.pi * hertz[inside] * STEP_SAMPLES / sample_rate_hz)
    steps = (_left(first, factor * first, weights) for factor in (10 ** (STEP_DB / 20), late))
    smallest = SEEN_SHARE**2 * min(float(step.sum()) for step in steps)
    left, energy = _left(first, second, weights), np.sum(np.abs(first) ** 2, axis=1)
    noise = noise_share[0] * energy + noise_share[1] * np.sum(np.abs(second) ** 2, axis=1)
    # A step has its noise once. Noise that is not white is known within some 3 dB: twice of it must be exceeded.
    together = left.sum() / max(smallest + noise.sum(), 2 * noise.sum(), 1e-300)
    single = left / np.maximum(ROW_CHANGE**2 * energy + 2 * noise, 1e-300)
    return float(np.sqrt(max(together, single.max())))


def _left(first: Complex128Array, second: Complex128Array, weights: Float64Array) -> Float64Array:
    """Energy in each row of a change that no factors ``exp(c weights)`` explain, one c for each part of the band."""
    energy = np.zeros(len(first))
    for bins in np.array_split(np.arange(first.shape[1]), min(GROUPS, first.shape[1])):
        before, after, factor = first[:, bins], second[:, bins], 0j
        for _ in range(4):  # Gauss-Newton; the changes are small
            model = before * np.exp(factor * weights[:, None])
            slope = model * weights[:, None]
            power = float(np.sum(np.abs(slope) ** 2))
            if power > 0.0:
                factor += np.vdot(slope, after - model) / power
                factor /= max(1.0, abs(factor) / 0.5)
        energy += np.sum(np.abs(after - before * np.exp(factor * weights[:, None])) ** 2, axis=1)
    return energy


def compare_sentinel(
    then: Float32Array,
    now: Float32Array,
    snr_db: Float32Array | None = None,
    noise_share: tuple[Float64Array, Float64Array] | None = None,
    *,
    band_hz: tuple[float, float] | None = None,
    sample_rate_hz: float = 1.0,
) -> DriftFigures:
    """Compare two measurements of one position.

    then, now, float32 (actuators, taps): Green's functions of the first and of the new measurement.
    snr_db, float32 (actuators,): Signal-to-noise ratios of the first, NaN where unknown; by default all are clear.
    noise_share, float64 (actuators,): Share that noise has in the energy of each row, of either; by default none. It is
        taken out of energies and correlation.
    band_hz: Measured band; what a fit leaves outside of it says nothing of the plate.
    sample_rate_hz: Of the Green's functions.

    Returns figures pooled over the clear responses, so that the strong ones, which carry the information, decide.
    """
    first, second = then.astype(np.float64), now.astype(np.float64)
    ratio_db = np.full(len(first), np.inf) if snr_db is None else np.nan_to_num(snr_db.astype(np.float64), nan=np.inf)
    shares = (np.zeros(len(first)),) * 2 if noise_share is None else noise_share
    # Noisy responses say nothing of a drift, unless none is clear; one that has vanished since is no noise.
    clear = ratio_db >= min(CLEAR_DB, float(np.max(ratio_db, initial=-np.inf)))
    first, second = first[clear], second[clear]
    length = 2 * first.shape[1]
    cycles = np.arange(length // 2 + 1) / length
    low, high = (0.0, 0.5) if band_hz is None else (edge_hz / sample_rate_hz for edge_hz in band_hz)
    within = (cycles >= low) & (cycles <= high)
    spectra = [np.fft.rfft(green, length, axis=1) * within for green in (first, second)]
    energies, noise = [], []
    for part, share in zip(spectra, shares, strict=True):
        each = np.sum(np.fft.irfft(part, length, axis=1) ** 2, axis=1)
        energies.append(float(each.sum()))
        noise.append(float(each @ share[clear]) / max(energies[-1], 1e-300))
    energy_then, energy_now = energies
    apart = float(np.sum(np.fft.irfft(spectra[1] - spectra[0], length, axis=1) ** 2))
    change = np.sqrt(max(apart - noise[0] * energies[0] - noise[1] * energies[1], 0.0) / max(energies[0], 1e-300))
    if energy_then == 0.0 or energy_now == 0.0:
        return DriftFigures(-np.inf if energy_now == 0.0 else np.inf, 0.0, 0.0)
    spectrum = np.sum(np.conj(spectra[0]) * spectra[1], axis=0)
    lagged = np.fft.irfft(spectrum, length)
    peak = int(np.argmax(lagged))
    delay = peak + parabola_vertex(lagged[peak - 1], lagged[peak], lagged[(peak + 1) % length])
    delay -= 0 if peak < length // 2 else length
    signal_then, signal_now = (
        energy * (1.0 - share) for energy, share in zip(energies, np.minimum(noise, 0.9).tolist(), strict=True)
    )
    return DriftFigures(
        level_db=10.0 * np.log10(signal_now / signal_then),
        delay_samples=float(delay),
        correlation=min(float(lagged[peak] / np.sqrt(signal_then * signal_now)), 1.0),
        noise_db=10.0 * np.log10(1.0 + sum(noise)),
        change=float(change),
    )
