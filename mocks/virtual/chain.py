"""From player volts to vibrometer volts: everything on the way but the plate, all causal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

AMPLIFIER_CORNER_HZ = 20.0  # the paper, section IV.A: amplified voltage signals from 20 Hz
# Butterworth of two orders rather than one: the plate's slow diffusion would leave a long tail at the lowest
# frequencies.
AMPLIFIER_DAMPING = np.sqrt(2)
COIL_OHM = 14.0  # the paper, section IV.A
COIL_H = 5e-3  # the paper, section IV.A
# The decoder's low-pass. With coil and magnet it leaves -85 dB at 5 kHz, so that 10 kHz is free of
# aliasing and the FIR of pre-ringing; a Bessel filter, for it does not ring itself.
VIBROMETER_CORNER_HZ = 1200.0
# Poles of the Bessel filter of order 4 with -3 dB at 1 rad/s, each with its conjugate (`scipy.signal.bessel` with
# norm="mag", whose import would cost every command half a second).
VIBROMETER_POLES = (-0.995208764350272 + 1.257105739454664j, -1.3700678305514422 + 0.41024971749375155j)


def chain_response(frequency_hz: Float64Array) -> Complex128Array:
    """Amplifier, coil and vibrometer as one transfer function, 1 in the middle of the band.

    frequency_hz, float64 array: Frequencies in Hz, >= 0.
    """
    frequency = np.asarray(frequency_hz, dtype=np.float64)
    slow = 1j * frequency / AMPLIFIER_CORNER_HZ
    amplifier = slow**2 / (slow**2 + AMPLIFIER_DAMPING * slow + 1)
    coil = COIL_OHM / (COIL_OHM + 2j * np.pi * frequency * COIL_H)
    fast = 1j * frequency / VIBROMETER_CORNER_HZ
    response = np.asarray(amplifier * coil, dtype=np.complex128)
    for pole in VIBROMETER_POLES:
        response *= abs(pole) ** 2 / ((fast - pole) * (fast - pole.conjugate()))
    return response


def actuator_gains(actuators: int, spread_db: float, seed: int) -> Float64Array:
    """Gain of each actuator, evenly spread in decibels; the polarity is the same for all.

    actuators: Number of actuators.
    spread_db: Largest deviation from 0 dB, >= 0.
    seed: Seed of the rig.
    """
    level_db = np.random.default_rng([seed, 0x6A1]).uniform(-spread_db, spread_db, actuators)
    return np.asarray(10 ** (level_db / 20), dtype=np.float64)


def output_errors(
    outputs: int, latency_spread_s: float, gain_spread_db: float, seed: int
) -> tuple[Float64Array, Float64Array]:
    """What calibration has to find of a player's outputs: latency and gain of each, evenly spread.

    outputs: Number of outputs.
    latency_spread_s: Largest deviation of an output's latency in s, >= 0.
    gain_spread_db: Largest deviation of an output's gain in dB, >= 0.
    seed: Seed of the rig.

    Returns tuple of float64 (outputs,): latencies in s and gains.
    """
    chance = np.random.default_rng([seed, 0x0F7])
    latency_s = chance.uniform(-latency_spread_s, latency_spread_s, outputs)
    gain_db = chance.uniform(-gain_spread_db, gain_spread_db, outputs)
    return np.asarray(latency_s), np.asarray(10 ** (gain_db / 20), dtype=np.float64)
