"""Crosstalk: the share of the loopback voltage that leaks into the response input, measured while only it plays."""

import json
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavefocus.calibration.evidence import SIGMAS, SOUND

MAX_DELAY_S = 0.02
"""Longest delay looked for: the longest of the buffers of an audio interface (1024 samples at 48 kHz are 21 ms)."""
SPARE = 10 ** (-1 / 20)
"""A leak counts from 1 dB below a limit, so that one that is just at the limit counts whatever its noise."""
UNKNOWN_ROWS_SHARE = 0.01 * SOUND
"""Where there is no bank: what is named of rows that answer 10 mV per volt."""
NONE_DB = -200.0
"""What a bank keeps where no leak stands out of the noise: below any converter's range."""
REMEDY = (
    "put a grounded channel between the two inputs in the converter's scan list, lower the source impedance or the "
    "conversion clock; keep the vibrometer's cable away from amplifiers, coils and magnets, and ground it once"
)


@dataclass(frozen=True, slots=True)
class Crosstalk:
    """A leak of the loopback into the response input.

    share: Volts at the response input per volt of the loopback; negative where it is upside down.
    delay_s: How much later it comes than the loopback's voltage.
    error: Standard error of the share.
    """

    share: float
    delay_s: float
    error: float

    @property
    def level_db(self) -> float:
        """Level re the loopback in dB."""
        return _decibel(abs(self.share))

    @property
    def is_seen(self) -> bool:
        """Whether it stands out of the noise."""
        return abs(self.share) >= SIGMAS * self.error

    @property
    def visible_db(self) -> float:
        """Level from which on a leak would have been seen, in dB re the loopback."""
        return _decibel(SIGMAS * self.error)

    def reaches(self, share: float) -> bool:
        """Whether it is seen and as large as this share of the loopback."""
        return self.is_seen and abs(self.share) >= SPARE * share

    def resolves(self, share: float) -> bool:
        """Whether a leak of this share would have been seen."""
        return SIGMAS * self.error <= share

    def __str__(self) -> str:
        if not self.is_seen:
            return f"below {self.visible_db:z.0f} dB re the loopback"
        return f"{self.level_db:.1f} dB re the loopback, {1e3 * self.delay_s:.2f} ms late"


def crosstalk_of_record(
    reference_v: ArrayLike,
    response_v: ArrayLike,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    *,
    reference_gain: float = 1.0,
    inter_channel_delay_s: float = 0.0,
) -> Crosstalk:
    """Measure the leak in a record in which no response is expected: only the loopback plays, or no light comes back.

    The response is correlated with the reference in the band; the leak is the largest value, refined between samples.

    reference_v, response_v, (samples,): The two channels in volts.
    band_hz: Lowest and highest frequency of what was played.
    reference_gain: Volts at the reference input per volt of the loopback.
    inter_channel_delay_s: How much later the response input is sampled.
    """
    reference, response = (np.asarray(channel, dtype=np.float64) for channel in (reference_v, response_v))
    size = 1 << math.ceil(math.log2(reference.size + MAX_DELAY_S * sample_rate_hz))
    hertz = np.fft.rfftfreq(size, 1 / sample_rate_hz)
    inside = (hertz >= band_hz[0]) & (hertz <= band_hz[1])
    played, received = (np.where(inside, np.fft.rfft(channel, size), 0.0) for channel in (reference, response))
    energy = float(np.sum(np.abs(played) ** 2))
    if energy == 0.0:
        return Crosstalk(0.0, 0.0, math.inf)
    cross = np.conj(played) * received / energy
    lagged = np.fft.irfft(cross, size) * size / 2  # the real part of the sum over the band
    latest = math.ceil(MAX_DELAY_S * sample_rate_hz)
    lag = int(np.argmax(np.abs(lagged[: latest + 1])))
    angular, terms = 2 * np.pi * hertz[inside], cross[inside]
    late_s = lag / sample_rate_hz
    for step_s in (1 / 16 / sample_rate_hz, 1 / 256 / sample_rate_hz):
        tried_s = late_s + step_s * np.arange(-16, 17)
        shares = (np.exp(1j * np.outer(tried_s, angular)) @ terms).real
        best = int(np.argmax(np.abs(shares)))
        late_s, share = float(tried_s[best]), float(shares[best])
    left = received[inside] - share * np.exp(-1j * angular * late_s) * played[inside]
    error = math.sqrt(float(np.mean(np.abs(left) ** 2)) / (2 * energy))
    return Crosstalk(share * reference_gain, late_s + inter_channel_delay_s, error * reference_gain)


def leak_limit(
    rms: NDArray[np.floating], taps: int, sample_rate_hz: float, band_hz: tuple[float, float], response_per_volt: float
) -> float | None:
    """Share of the loopback at which a leak is 1 % of the median row, by its norm; None without rows.

    A leak of share c adds to every row, which is per volt of drive, a pulse that is c times `response_per_volt` at the
    frequencies of the band and nothing beyond.

    rms: Root mean square over the taps of each Green's function, NaN where unknown.
    response_per_volt: Response unit per volt at the response input.
    """
    known = rms[np.isfinite(rms) & (rms > 0)]
    if not known.size or not np.isfinite(response_per_volt) or response_per_volt == 0:
        return None
    pulse = abs(response_per_volt) * math.sqrt(2 * (band_hz[1] - band_hz[0]) / sample_rate_hz)
    return SOUND * float(np.median(known)) * math.sqrt(taps) / pulse


def response_per_volt(rig_json: str | None) -> float | None:
    """The vibrometer's sensitivity as a bank's rig has it; None where it was asked of the instrument, or is unknown."""
    try:
        sensitivity = json.loads(rig_json or "{}")["vibrometer"]["sensitivity_m_s_per_v"]
        return float(sensitivity) if float(sensitivity) > 0 else None
    except (KeyError, TypeError, ValueError, RecursionError):
        return None


def _decibel(share: float) -> float:
    return 20 * math.log10(max(share, 1e-12))
