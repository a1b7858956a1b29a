"""From player volts to vibrometer volts: everything on the way but the plate, all causal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.signal import bessel, butter

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

AMPLIFIER_CORNER_HZ = 20.0  # the paper, section IV.A: amplified voltage signals from 20 Hz
# Two orders rather than one: the plate's slow diffusion would leave a long tail at the lowest frequencies.
AMPLIFIER_ORDER = 2
COIL_OHM = 14.0  # the paper, section IV.A
COIL_H = 5e-3  # the paper, section IV.A
# The decoder's low-pass. With coil and magnet it leaves -85 dB at 5 kHz, so that 10 kHz is free of
# aliasing and the FIR of pre-ringing; a Bessel filter, for it does not ring itself.
VIBROMETER_CORNER_HZ = 1200.0
VIBROMETER_ORDER = 4


def chain_response(frequency_hz: Float64Array) -> Complex128Array:
    """Amplifier, coil and vibrometer as one transfer function, 1 in the middle of the band.

    Parameters
    ----------
    frequency_hz : float64 array
        Frequencies in Hz, >= 0.
    """
    angular = 2 * np.pi * np.asarray(frequency_hz, dtype=np.float64)
    amplifier = butter(AMPLIFIER_ORDER, 2 * np.pi * AMPLIFIER_CORNER_HZ, "high", analog=True, output="zpk")
    vibrometer = bessel(
        VIBROMETER_ORDER, 2 * np.pi * VIBROMETER_CORNER_HZ, "low", analog=True, output="zpk", norm="mag"
    )
    coil = COIL_OHM / (COIL_OHM + 1j * angular * COIL_H)
    response = coil.astype(np.complex128)
    for zeros, poles, gain in (amplifier, vibrometer):
        response *= float(gain)
        for zero in zeros:
            response *= 1j * angular - zero
        for pole in poles:
            response /= 1j * angular - pole
    return response


def actuator_gains(actuators: int, spread_db: float, seed: int) -> Float64Array:
    """Gain of each actuator, evenly spread in decibels; the polarity is the same for all.

    Parameters
    ----------
    actuators : int
        Number of actuators.
    spread_db : float
        Largest deviation from 0 dB, >= 0.
    seed : int
        Seed of the rig.
    """
    level_db = np.random.default_rng([seed, 0x6A1]).uniform(-spread_db, spread_db, actuators)
    return np.asarray(10 ** (level_db / 20), dtype=np.float64)
