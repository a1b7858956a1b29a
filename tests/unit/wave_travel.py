"""What plates are held against: how an impulse travels on a wave, and the Green's function of a thin plate."""

from typing import NamedTuple

import numpy as np
import scipy.special

from wavefocus.mocks.plates.soft import DampedWave


class WaveTravel(NamedTuple):
    group_velocity_m_s: float
    attenuation_db_per_cm: float


def impulse_travel(wave, band_hz=(50.0, 450.0), span_mm=(10.0, 50.0)):
    """Of an impulse with a flat spectrum in the band, its spreading removed: exp(-j k r).

    The velocity is the distance over the delay between the centroids of energy at the two ends of the span; the
    attenuation is the loss of energy between them.
    """
    frequency_hz = np.linspace(*band_hz, 401)
    k = wave.wavenumber(frequency_hz)
    if isinstance(wave, DampedWave):
        damped = 4 * np.pi * frequency_hz - 1j * wave.damping_per_s
        slowness = (damped / (2 * k * wave.speed_m_s**2)).real
    else:
        slowness = (1 - 0.5 * wave.exponent) * k.real / (2 * np.pi * frequency_hz)
    near_m, far_m = np.array(span_mm) / 1e3
    near, far = (np.exp(2 * k.imag * distance_m) for distance_m in (near_m, far_m))
    delay_s = far_m * np.average(slowness, weights=far) - near_m * np.average(slowness, weights=near)
    loss_db = 10 * np.log10(near.sum() / far.sum())
    return WaveTravel((far_m - near_m) / delay_s, loss_db / (100 * (far_m - near_m)))


def thin_plate_green(k, radius_m):
    """-j / (8 k^2) [H0(2)(k r) - (2j / pi) K0(k r)], r > 0 (Timoshenko and Woinowsky-Krieger 1959)."""
    z = k * np.asarray(radius_m)
    return -1j / (8 * k * k) * (scipy.special.hankel2(0, z) - 2j / np.pi * scipy.special.kv(0, z))
