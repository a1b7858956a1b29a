"""Small banks of the analytic soft plate, with the truth at any point."""

from functools import lru_cache

import numpy as np

from wavefocus.mocks.plates.soft import SOFT_PLATE
from wavefocus.rendering.greens.source import GreenArray

RATE_HZ = 2000.0
TAPS = 256
DELAY_S = 0.02
"""Room for what the band's edges ring ahead of the wave."""
BAND_HZ = (50.0, 500.0)
SPACING_MM = 4.0
AXIS_MM = SPACING_MM * (np.arange(13) - 6)
SQUARE_MM = np.stack(np.meshgrid(AXIS_MM, AXIS_MM), axis=-1).reshape(-1, 2)
ANGLES = 2.0 * np.pi * (np.arange(10) + 0.3) / 10
ACTUATOR_MM = np.stack([62.0 * np.cos(ANGLES), 50.0 * np.sin(ANGLES)], axis=1)


def plate_spectra(points_mm):
    """Transfer functions (points, actuators, bins) of a transform of TAPS, limited to the band."""
    frequency = np.fft.rfftfreq(TAPS, 1.0 / RATE_HZ)
    radius_mm = np.hypot(*(np.asarray(points_mm)[:, None] - ACTUATOR_MM).transpose(2, 0, 1))
    octaves = np.log2(np.maximum(frequency, 1.0) / np.array(BAND_HZ)[:, None])
    outside = np.maximum(-octaves[0], octaves[1])
    window = 0.5 + 0.5 * np.cos(np.pi * np.clip(outside / 0.5, 0.0, 1.0))
    heard = window > 0.0
    spectra = np.zeros((*radius_mm.shape, len(frequency)), dtype=np.complex128)
    delayed = window[heard] * np.exp(-2j * np.pi * frequency[heard] * DELAY_S)
    spectra[..., heard] = SOFT_PLATE.velocity(frequency[heard], radius_mm[..., None]) * delayed
    return spectra


def plate_greens(points_mm):
    """Green's functions (points, actuators, TAPS); a copy of what was computed for the same points before."""
    points_mm = np.asarray(points_mm, dtype=np.float64)
    return _greens(points_mm.tobytes(), points_mm.shape).copy()


@lru_cache(16)
def _greens(points, shape):
    return np.fft.irfft(plate_spectra(np.frombuffer(points).reshape(shape)), TAPS, axis=2)


def plate_bank(position_mm=SQUARE_MM, *, noise_db=None, seed=0, status=None):
    """A bank of the plate; noise within the band, relative to each pair."""
    position_mm = np.asarray(position_mm, dtype=np.float64)
    values = plate_greens(position_mm)
    if noise_db is not None:
        spectrum = np.fft.rfft(np.random.default_rng(seed).standard_normal(values.shape), axis=2)
        frequency = np.fft.rfftfreq(TAPS, 1.0 / RATE_HZ)
        spectrum[..., (frequency < BAND_HZ[0]) | (frequency > BAND_HZ[1])] = 0.0
        noise = np.fft.irfft(spectrum, TAPS, axis=2)
        scale = np.linalg.norm(values, axis=2) / np.linalg.norm(noise, axis=2)
        values = values + 10 ** (noise_db / 20) * scale[..., None] * noise
    return GreenArray(values, position_mm, RATE_HZ, status=status, actuator_mm=ACTUATOR_MM, band_hz=BAND_HZ)


NOISE_MM = np.array([(4.0 * x - 16.0, 4.0 * y - 12.0) for y in range(7) for x in range(9)])


def noise_bank(taps=60, actuators=3, seed=0, *, scale=1.0, **options):
    """Random rows at 1 kHz; all doubtful: to judge what lies between their positions takes longer than a render."""
    values = scale * np.random.default_rng(seed).standard_normal((len(NOISE_MM), actuators, taps))
    return GreenArray(values, NOISE_MM, 1000.0, **{"status": np.full(len(NOISE_MM), 4, np.uint8), **options})


def errors_at(frequency_hz, greens, points_mm):
    """Relative errors of Green's functions at points: L2 norms over the actuators, (points,)."""
    index = round(frequency_hz * TAPS / RATE_HZ)
    found = np.fft.rfft(greens, axis=2)[..., index]
    right = plate_spectra(points_mm)[..., index]
    return np.linalg.norm(found - right, axis=1) / np.linalg.norm(right, axis=1)
