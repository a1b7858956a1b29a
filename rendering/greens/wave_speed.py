"""How fast waves travel, as far as a few rows of the bank can tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rendering.greens.source import GreenSource, read_row

ROWS = 12
LEAST_CORRELATION = 0.7
MOST_DOUBT = 1 / 3
"""Largest standard error of a speed, as a share of it, with which it is told."""


def wave_speed_mm_s(bank: GreenSource, rows: Sequence[int]) -> tuple[float, float] | None:
    """Estimate the wave speed from the energy's arrival over the distance.

    The arrival of a Green's function is the instant by which half its energy has come; the speed is the
    inverse slope of a straight line through arrivals over distances, a rough figure meant for a warning.

    Parameters
    ----------
    bank : GreenSource
        With known actuator positions.
    rows : sequence of int
        Measured rows; at most 12 of them, evenly chosen, are looked at.

    Returns
    -------
    (float, float) or None
        Speed and its standard error in millimetres per second; None where positions are unknown or arrivals do
        not follow distances.
    """
    actuator_mm = np.asarray(bank.actuator_mm, dtype=np.float64)
    known = np.isfinite(actuator_mm).all(axis=1)
    if not known.any():
        return None
    distances, arrivals = [], []
    for index in np.unique(np.linspace(0, len(rows) - 1, min(ROWS, len(rows))).astype(int)):
        green = read_row(bank, rows[int(index)]).values
        energy = np.cumsum(np.square(green), axis=1)
        heard = known & (energy[:, -1] > 0)
        arrival = np.argmax(energy >= energy[:, -1:] / 2, axis=1)
        offset = actuator_mm - np.asarray(bank.position_mm)[rows[int(index)]]
        distances.append(np.hypot(offset[heard, 0], offset[heard, 1]))
        arrivals.append(arrival[heard] / bank.sample_rate_hz)
    distance = np.concatenate([*distances, np.zeros(0)])
    arrival_s = np.concatenate([*arrivals, np.zeros(0)])
    if len(distance) < 3 or np.ptp(distance) == 0 or np.ptp(arrival_s) == 0:
        return None
    if np.corrcoef(distance, arrival_s)[0, 1] < LEAST_CORRELATION:
        return None
    slope, offset = np.polyfit(distance, arrival_s, 1)
    left = arrival_s - slope * distance - offset
    error = np.sqrt(left @ left / (len(distance) - 2)) / np.linalg.norm(distance - distance.mean())
    if error > MOST_DOUBT * slope:
        return None
    return float(1.0 / slope), float(error / slope**2)
