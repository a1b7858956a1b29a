"""How band-limited impulses travel on the surface, from the bank: group velocity and attenuation (section III)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rendering.field.metrics import band_limited
from rendering.greens.source import GreenSource, read_row, usable
from storage.errors import InputError

Float64Array = NDArray[np.float64]

IMPULSE_BAND_HZ = (50.0, 450.0)
"""The paper's band of impulses."""
SPAN_MM = (20.0, 100.0)
MOST_ROWS = 96
FEWEST_PAIRS = 20
LEAST_CORRELATION = 0.7


@dataclass(frozen=True, slots=True)
class ImpulseTravel:
    """Travel of band-limited impulses.

    group_velocity_m_s: Inverse slope of the energy's mean arrival over distance.
    attenuation_db_per_cm: Loss of energy per distance, spreading removed; positive where waves die away.
    velocity_error_m_s, attenuation_error_db_per_cm: Standard errors of the two figures.
    correlation: Of arrivals and distances, means of each actuator removed; -1 to 1.
    """

    group_velocity_m_s: float
    attenuation_db_per_cm: float
    velocity_error_m_s: float
    attenuation_error_db_per_cm: float
    correlation: float

    @property
    def is_sure(self) -> bool:
        """Arrivals follow distances well enough for a velocity; in a room they do not."""
        return self.correlation >= LEAST_CORRELATION and 3.0 * self.velocity_error_m_s <= self.group_velocity_m_s


def impulse_travel(
    bank: GreenSource,
    band_hz: tuple[float, float] | None = IMPULSE_BAND_HZ,
    span_mm: tuple[float, float] = SPAN_MM,
    rows: Sequence[int] | None = None,
) -> ImpulseTravel:
    """Fit group velocity and attenuation to the bank's Green's functions.

    Each Green's function is limited to the band, which makes it the response to a band-limited impulse. Its
    arrival is the centroid of its energy, ``sum t g^2 / sum g^2``; its level is ``10 lg(r sum g^2)``, the
    distance r taking away the spreading of a wave on a surface. Arrival and level over distance are each
    fitted by a straight line, for each actuator with an offset of its own.

    band_hz: Band of the impulse; None: the Green's functions as they are.
    span_mm: Distances that are used, above 0.
    rows: Rows to choose from; by default all usable ones.
    """
    allowed = np.flatnonzero(usable(bank)) if rows is None else np.asarray(rows, dtype=np.int64)
    allowed = allowed[np.unique(np.linspace(0, len(allowed) - 1, min(MOST_ROWS, len(allowed))).astype(np.int64))]
    actuator_mm = np.asarray(bank.actuator_mm, dtype=np.float64)
    distance, arrival, level, actuator = ([] for _ in range(4))
    time_s = np.arange(bank.taps) / bank.sample_rate_hz
    for row in allowed.tolist():
        apart_mm = np.hypot(*(actuator_mm - np.asarray(bank.position_mm)[row]).T)
        near = np.flatnonzero((apart_mm >= span_mm[0]) & (apart_mm <= span_mm[1]))
        if not len(near):
            continue
        scaled = read_row(bank, row)
        green = scaled.values[near]
        energy = np.square(green if band_hz is None else band_limited(green, bank.sample_rate_hz, band_hz))
        total = energy.sum(axis=1)
        driven = total > 0
        distance.append(apart_mm[near][driven])
        arrival.append((energy[driven] @ time_s) / total[driven])
        level.append(10.0 * np.log10(apart_mm[near][driven] * total[driven]) + 20.0 * np.log10(2.0) * scaled.exponent)
        actuator.append(near[driven])
    pairs = sum(map(len, distance))
    if pairs < FEWEST_PAIRS:
        raise InputError(
            f"only {pairs} pairs of a measured position and an actuator of known place lie {span_mm[0]:g} to"
            f" {span_mm[1]:g} mm apart; at least {FEWEST_PAIRS} are needed for a velocity"
        )
    of = np.concatenate(actuator)
    arrivals = _fit(np.concatenate(distance), np.concatenate(arrival), of)
    levels = _fit(np.concatenate(distance), np.concatenate(level), of)
    velocity = 1e-3 / arrivals.slope if arrivals.slope else np.inf
    return ImpulseTravel(
        velocity,
        -10.0 * levels.slope,
        velocity_error_m_s=abs(velocity * arrivals.doubt / arrivals.slope) if arrivals.slope else np.inf,
        attenuation_error_db_per_cm=10.0 * levels.doubt,
        correlation=arrivals.correlation,
    )


@dataclass(frozen=True, slots=True)
class _Line:
    slope: float
    doubt: float
    """Standard error of the slope: the larger one of least squares and of leaving out one actuator at a time."""
    correlation: float


def _fit(distance_mm: Float64Array, value: Float64Array, actuator: NDArray[np.int64]) -> _Line:
    """Common slope of straight lines with an offset per actuator."""
    _, group = np.unique(actuator, return_inverse=True)
    count = np.bincount(group)
    x = distance_mm - (np.bincount(group, distance_mm) / count)[group]
    y = value - (np.bincount(group, value) / count)[group]
    slope = float(x @ y) / float(x @ x)
    left = y - slope * x
    doubt = float(np.sqrt(left @ left / max(1, len(x) - len(count) - 1) / (x @ x)))
    # What one actuator's waves meet is alike at neighbouring positions, so that pairs are no independent samples.
    xy, xx = np.bincount(group, x * y), np.bincount(group, x * x)
    if len(count) > 2 and (xx.sum() - xx > 0).all():
        without = (xy.sum() - xy) / (xx.sum() - xx)
        jackknife = (len(count) - 1) / len(count) * np.sum(np.square(without - without.mean()))
        doubt = max(doubt, float(np.sqrt(jackknife)))
    power = float(np.sqrt((x @ x) * (y @ y)))
    return _Line(slope, doubt, float(x @ y) / power if power else 0.0)
