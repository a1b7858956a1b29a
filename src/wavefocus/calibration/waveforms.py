"""Waveforms of an excitation by the values of `sweep.waveform`: one base signal, any scale, without fades and silence.

A function takes the times (samples,) from 0 on and before the duration, the band in Hz and the duration in s.
"""

import numpy as np

from wavefocus.calibration import Float64Array

CLIPPED_AT = 0.8
ROUNDS = 60
"""More hardly lower the peak: it is 1.7 to 2.0 times the rms by then, and 4 with random phases."""


def linear(time_s: Float64Array, band_hz: tuple[float, float], duration_s: float) -> Float64Array:
    """A linear sweep: its energy is even over the band, and each moment has one frequency."""
    slope = (band_hz[1] - band_hz[0]) / (2 * duration_s)
    return np.asarray(np.sin(2 * np.pi * (band_hz[0] + slope * time_s) * time_s))


def multisine(time_s: Float64Array, band_hz: tuple[float, float], duration_s: float) -> Float64Array:
    """All frequencies of the band throughout, so that a disturbance costs each of them a little.

    Its phases are random, the same in every run, and then turned until the peak is about twice the rms, by clipping in
    time and keeping the phases only (Van der Ouderaa, Schoukens and Renneboog, IEEE Trans. Instrum. Meas. 37, 1988).
    """
    import scipy.fft  # slow to load, and sweeps do without

    samples = time_s.size
    bins = np.arange(int(np.ceil(band_hz[0] * duration_s)), int(band_hz[1] * duration_s) + 1)
    phase = 2 * np.pi * np.random.default_rng(0).random(bins.size)
    spectrum = np.zeros(samples // 2 + 1, dtype=np.complex128)
    signal = np.zeros(samples)
    for _ in range(ROUNDS):
        spectrum[bins] = np.exp(1j * phase)
        signal = scipy.fft.irfft(spectrum, samples)
        peak = CLIPPED_AT * np.abs(signal).max()
        phase = np.angle(scipy.fft.rfft(np.clip(signal, -peak, peak))[bins])
    return np.asarray(signal)


WAVEFORMS = {"linear": linear, "multisine": multisine}
