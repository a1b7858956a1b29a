"""How band-limited impulses travel on the surface, from the bank: group velocity and attenuation (section III)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import InputError
from rendering.green_source import GreenSource, read_row, usable
from rendering.metrics import band_limited

Float64Array = NDArray[np.float64]

IMPULSE_BAND_HZ = (50.0, 450.0)
"""The paper's band of impulses."""
SPAN_MM = (20.0, 100.0)
MOST_ROWS = 96
FEWEST_PAIRS = 20


@dataclass(frozen=True, slots=True)
class ImpulseTravel:
    """Travel of band-limited impulses.

    Parameters
    ----------
    group_velocity_m_s : float
        Inverse slope of the energy's mean arrival over distance.
    attenuation_db_per_cm : float
        Loss of energy per distance, spreading removed; positive where waves die away.
    pairs : int
        Pairs of position and actuator that were used.
    scatter_s, scatter_db : float
        Rms of what the two straight lines leave of arrivals and of levels.
    """

    group_velocity_m_s: float
    attenuation_db_per_cm: float
    pairs: int
    scatter_s: float
    scatter_db: float


def impulse_travel(
    bank: GreenSource, band_hz: tuple[float, float] = IMPULSE_BAND_HZ, span_mm: tuple[float, float] = SPAN_MM
) -> ImpulseTravel:
    """Fit group velocity and attenuation to the bank's Green's functions.

    Each Green's function is limited to the band, which makes it the response to a band-limited impulse. Its
    arrival is the centroid of its energy, ``sum t g^2 / sum g^2``; its level is ``10 lg(r sum g^2)``, the
    distance r taking away the spreading of a wave on a surface. Arrival and level over distance are each
    fitted by a straight line, for each actuator with an offset of its own.

    Parameters
    ----------
    bank : GreenSource
        With known actuator positions.
    band_hz : tuple of float
        Band of the impulse.
    span_mm : tuple of float
        Distances that are used.

    Raises
    ------
    InputError
        Too few pairs of a measured position and an actuator of known place are that far apart.
    """
    rows = np.flatnonzero(usable(bank))
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(MOST_ROWS, len(rows))).astype(np.int64))]
    actuator_mm = np.asarray(bank.actuator_mm, dtype=np.float64)
    distance, arrival, level, actuator = ([] for _ in range(4))
    time_s = np.arange(bank.taps) / bank.sample_rate_hz
    for row in rows.tolist():
        apart_mm = np.hypot(*(actuator_mm - np.asarray(bank.position_mm)[row]).T)
        near = np.flatnonzero((apart_mm >= span_mm[0]) & (apart_mm <= span_mm[1]))
        if not len(near):
            continue
        scaled = read_row(bank, row)
        energy = np.square(band_limited(scaled.values[near], bank.sample_rate_hz, band_hz))
        total = energy.sum(axis=1)
        heard = total > 0
        distance.append(apart_mm[near][heard])
        arrival.append((energy[heard] @ time_s) / total[heard])
        level.append(10.0 * np.log10(apart_mm[near][heard] * total[heard]) + 20.0 * np.log10(2.0) * scaled.exponent)
        actuator.append(near[heard])
    pairs = sum(map(len, distance))
    if pairs < FEWEST_PAIRS:
        raise InputError(
            f"only {pairs} pairs of a measured position and an actuator of known place lie {span_mm[0]:g} to"
            f" {span_mm[1]:g} mm apart; at least {FEWEST_PAIRS} are needed to tell how impulses travel"
        )
    of = np.concatenate(actuator)
    slowness, scatter_s = _slope(np.concatenate(distance), np.concatenate(arrival), of)
    loss, scatter_db = _slope(np.concatenate(distance), np.concatenate(level), of)
    return ImpulseTravel(1e-3 / slowness, -10.0 * loss, pairs, scatter_s, scatter_db)


def _slope(distance_mm: Float64Array, value: Float64Array, actuator: NDArray[np.int64]) -> tuple[float, float]:
    """Common slope of straight lines with an offset per actuator, and the rms of what they leave."""
    _, group = np.unique(actuator, return_inverse=True)
    count = np.bincount(group)
    x = distance_mm - (np.bincount(group, distance_mm) / count)[group]
    y = value - (np.bincount(group, value) / count)[group]
    slope = float(x @ y) / float(x @ x)
    return slope, float(np.sqrt(np.mean(np.square(y - slope * x))))
