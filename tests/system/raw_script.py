"""Raw recordings as somebody else would write them, after docs/reference/files.md: NumPy and h5py, nothing of ours.

What is played is a formula, so that both channels are computed at the DAQ's own instants without resampling:
a response is the sum over its taps of the formula at earlier instants. The noise's own limit follows from the
same matrix by least squares.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

RATE_HZ = 5000.0
BAND_HZ = (50.0, 1000.0)
TAPS = 200
Signal = Callable[[np.ndarray], np.ndarray]


def sweep(duration_s: float, *, fade_s: float = 0.02, phase: float = 0.0, law: str = "linear") -> Signal:
    """A sweep through the band as a function of time; 0 before and after it."""
    low, high = BAND_HZ

    def signal(time_s: np.ndarray) -> np.ndarray:
        inside = (time_s >= 0) & (time_s < duration_s)
        t = np.where(inside, time_s, 0.0)
        cycles = low * t + (high - low) * t**2 / (2 * duration_s)
        if law == "exponential":
            growth = np.log(high / low)
            cycles = low * duration_s / growth * np.expm1(growth * t / duration_s)
        rise = np.clip(np.minimum(t, duration_s - t) / fade_s, 0, 1)
        return inside * np.sin(np.pi / 2 * rise) ** 2 * np.sin(2 * np.pi * cycles + phase)

    return signal


@dataclass
class Script:
    """A measurement of random FIRs, and what the noise alone must leave of error in it.

    Schedule: `slots` has for each record the (actuator, delay_s, gain) of its slots.
    """

    base: Signal
    slots: list[list[tuple[int, float, float]]]
    samples: int
    period_s: float = 0.0
    positions: int = 2
    ppm: float = 40.0
    snr_db: float = 40.0
    reference_gain: float = 1.0
    response_per_volt: float = 0.125
    inter_channel_delay_s: float = 0.0
    first_s: float = 0.05
    seed: int = 1
    green: np.ndarray = field(init=False)
    reference: np.ndarray = field(init=False)
    response: np.ndarray = field(init=False)
    noise_v: np.ndarray = field(init=False)
    starts: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        draw = np.random.default_rng(self.seed)
        actuators = 1 + max(slot[0] for record in self.slots for slot in record)
        shape = (self.positions, len(self.slots), self.samples)
        self.green = draw.standard_normal((self.positions, actuators, TAPS)) * np.exp(-np.arange(TAPS) / 60)
        self.reference, self.response = np.zeros(shape), np.zeros(shape)
        self.noise_v = np.zeros(shape[:2])
        # Anywhere in the period of what is already running; else some time after the record's start.
        span_s = self.period_s if self.period_s else self.first_s
        self.starts = span_s * draw.uniform(0.1, 0.9, shape[:2])
        for position in range(self.positions):
            for record, slots in enumerate(self.slots):
                times = self.times_s(position, record)
                later = times + self.inter_channel_delay_s
                volts = self.reference_gain * self.played(times)
                self.reference[position, record] = volts + 1e-3 * np.std(volts) * draw.standard_normal(self.samples)
                answer = np.zeros(self.samples)
                for actuator, delay_s, gain in slots:
                    answer += gain * self.steering(later - delay_s) @ self.green[position, actuator]
                answer /= self.response_per_volt
                self.noise_v[position, record] = np.std(answer) / np.sqrt(len(slots)) * 10 ** (-self.snr_db / 20)
                answer += self.noise_v[position, record] * draw.standard_normal(self.samples)
                self.response[position, record] = answer

    def times_s(self, position: int, record: int) -> np.ndarray:
        """Playback time of the DAQ's samples: its clock is `ppm` faster, and started on its own."""
        return np.arange(self.samples) / (RATE_HZ * (1 + 1e-6 * self.ppm)) - self.starts[position, record]

    def played(self, times_s: np.ndarray) -> np.ndarray:
        """The base signal in volts."""
        return self.base(times_s % self.period_s if self.period_s else times_s)

    def steering(self, times_s: np.ndarray) -> np.ndarray:
        """What each tap of one actuator alone would give, (samples, taps)."""
        return self.played(times_s[:, None] - np.arange(TAPS) / RATE_HZ)

    def write(self, path: Path, *, counts: bool = False, said: dict[str, object] | None = None) -> Path:
        """Write the file; `said` are root attributes besides those that are asked for."""
        width = max(len(record) for record in self.slots)
        actuator = np.full((len(self.slots), width), -1, np.int32)
        delay_s, gain = np.zeros(actuator.shape), np.zeros(actuator.shape)
        for record, slots in enumerate(self.slots):
            for slot, (one, late_s, strength) in enumerate(slots):
                actuator[record, slot], delay_s[record, slot], gain[record, slot] = one, late_s, strength
        with h5py.File(path, "w") as file:
            file.attrs["format"] = "wavefocus-raw"
            file.attrs["format_version"] = 1
            file.attrs["sample_rate_hz"] = RATE_HZ
            file.attrs["taps"] = TAPS
            file.attrs["band_hz"] = BAND_HZ
            file.attrs["response_per_volt"] = self.response_per_volt
            file.attrs["response_unit"] = "m/s"
            file.attrs["reference_gain"] = self.reference_gain
            file.attrs["inter_channel_delay_s"] = self.inter_channel_delay_s
            file.attrs["period_s"] = self.period_s
            for name, value in (said or {}).items():
                file.attrs[name] = value
            for name, volts in (("reference", self.reference), ("response", self.response)):
                if counts:
                    step = 1.02 * np.abs(volts).max() / 32768
                    file[name] = np.round(volts / step).astype(np.int16)
                    file[name].attrs["volts_per_count"] = step
                else:
                    file[name] = volts.astype(np.float32)
            file["schedule/actuator"] = actuator
            file["schedule/delay_s"] = delay_s
            file["schedule/gain"] = gain
            file["position_mm"] = np.column_stack([4.0 * np.arange(self.positions), np.zeros(self.positions)])
            file["actuator_mm"] = np.zeros((self.green.shape[1], 2))
        return path

    def error_db(self, green: np.ndarray) -> np.ndarray:
        """Relative L2 error of the spectra in band, (positions, actuators)."""
        wrong, right = _in_band(green - self.green), _in_band(self.green)
        return 10 * np.log10((np.abs(wrong) ** 2).sum(axis=-1) / (np.abs(right) ** 2).sum(axis=-1))

    def limit_db(self) -> np.ndarray:
        """The error that least squares with the true drives and the true clock must leave, in expectation."""
        limit = np.zeros(self.green.shape[:2])
        fourier = _in_band(np.eye(TAPS)).T
        for position in range(self.positions):
            for record, slots in enumerate(self.slots):
                times = self.times_s(position, record)
                model = [gain * self.steering(times - delay_s) for _, delay_s, gain in slots]
                matrix = np.concatenate(model, axis=1) / self.response_per_volt
                covariance = np.linalg.pinv(matrix.T @ matrix, rcond=1e-8, hermitian=True)
                covariance *= self.noise_v[position, record] ** 2
                for slot, (actuator, _, _) in enumerate(slots):
                    part = slice(slot * TAPS, (slot + 1) * TAPS)
                    noise = np.einsum("kn,nm,km->", fourier, covariance[part, part], fourier.conj()).real
                    energy = (np.abs(_in_band(self.green[position, actuator])) ** 2).sum()
                    limit[position, actuator] = 10 * np.log10(noise / energy)
        return limit


def _in_band(responses: np.ndarray) -> np.ndarray:
    length = 8 * TAPS
    hertz = np.arange(length // 2 + 1) * RATE_HZ / length
    return np.fft.rfft(responses, length)[..., (hertz >= BAND_HZ[0]) & (hertz <= BAND_HZ[1])]
