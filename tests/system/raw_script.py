"""Raw recordings as somebody else would write them, after docs/reference/files.md: NumPy and h5py, nothing of ours.

What is played is a formula, so that both channels are computed at the DAQ's own instants without resampling.
"""

from dataclasses import dataclass

import h5py
import numpy as np

from wavefocus.__main__ import run

ECHOES = 40


@dataclass
class Sweep:
    """A sweep as a function of time, for responses that are computed at the DAQ's own instants."""

    band_hz: tuple[float, float]
    duration_s: float
    law: str = "linear"

    def __call__(self, time_s):
        low, high = self.band_hz
        inside = (time_s >= 0) & (time_s < self.duration_s)
        since = np.where(inside, time_s, 0.0)
        cycles = low * since + (high - low) * since**2 / (2 * self.duration_s)
        if self.law == "exponential":
            growth = np.log(high / low)
            cycles = low * self.duration_s / growth * np.expm1(growth * since / self.duration_s)
        fade = np.clip(np.minimum(since, self.duration_s - since) / 0.01, 0, 1)
        return inside * np.sin(np.pi / 2 * fade) ** 2 * np.sin(2 * np.pi * cycles)


def echoes(actuators, taps, seed=0):
    """FIRs of a few echoes each, so that long ones are quickly computed."""
    draw = np.random.default_rng(seed)
    green = np.zeros((actuators, taps))
    for row in green:
        place = draw.choice(taps, ECHOES, replace=False)
        row[place] = draw.standard_normal(ECHOES) * np.exp(-3.0 * place / taps)
    return green


def swept(sweep, green, rate_hz, ppm, *, delays_s=None, tail_s=0.1, start_s=0.03, period_s=0.0, snr_db=40.0, seed=1):
    """Reference and response of one record (samples,): rows of `green` play together, each so much later.

    With a period the sweep comes again and again, and a record begins anywhere in it.
    """
    draw = np.random.default_rng(seed)
    delays_s = np.zeros(len(green)) if delays_s is None else delays_s
    seconds = 2 * period_s if period_s else start_s + sweep.duration_s + max(delays_s)
    samples = round((seconds + tail_s) * rate_hz)
    time_s = np.arange(samples) / (rate_hz * (1 + 1e-6 * ppm)) - start_s

    def played(at_s):
        return sweep(at_s % period_s if period_s else at_s)

    reference, response = played(time_s), np.zeros(samples)
    for row, delay_s in zip(green, delays_s, strict=True):
        for tap in np.flatnonzero(row):
            response += row[tap] * played(time_s - delay_s - tap / rate_hz)
    reference += 1e-3 * reference.std() * draw.standard_normal(samples)
    return reference, response + 10 ** (-snr_db / 20) * response.std() * draw.standard_normal(samples)


def write(path, records, taps, rate_hz, band_hz, *, slots=None, said=None, positions=1):
    """A raw file with the same records at each position.

    `slots` of each record are (actuators, delays_s), by default one actuator after the other.
    """
    slots = slots or [([record], [0.0]) for record in range(len(records))]
    with h5py.File(path, "w") as file:
        file.attrs.update(
            {
                "format": "wavefocus-raw", "format_version": 1, "sample_rate_hz": rate_hz, "taps": taps,
                "band_hz": band_hz, "response_per_volt": 1.0, "response_unit": "m/s", "reference_gain": 1.0,
                "inter_channel_delay_s": 0.0, "period_s": 0.0, **(said or {}),
            }
        )  # fmt: skip
        file["reference"] = np.array([[one[0] for one in records]] * positions, dtype=np.float32)
        file["response"] = np.array([[one[1] for one in records]] * positions, dtype=np.float32)
        file["schedule/actuator"] = np.array([one[0] for one in slots], dtype=np.int32)
        file["schedule/delay_s"] = np.array([one[1] for one in slots])
        file["schedule/gain"] = np.ones((len(slots), len(slots[0][0])))
        file["position_mm"] = np.column_stack([4.0 * np.arange(positions), np.zeros(positions)])
    return path


def estimated(raw, bank):
    assert run(["estimate", str(raw), "--bank", str(bank)]) == 0
    with h5py.File(bank) as file:
        assert file["status"][0] == 1
        return file["green"][0].astype(np.float64)


def error_db(found, truth, rate_hz, band_hz):
    length = 4 * truth.shape[1]
    hertz = np.arange(length // 2 + 1) * rate_hz / length
    band = (hertz >= band_hz[0]) & (hertz <= band_hz[1])
    wrong, right = (np.abs(np.fft.rfft(one, length)[:, band]) ** 2 for one in (found - truth, truth))
    return 10 * np.log10(wrong.sum(axis=1) / right.sum(axis=1))


def noise_limit_db(samples, taps, band_hz, rate_hz, snr_db):
    """White noise with the share of a record's freedom in band that so many taps take."""
    return -snr_db + 10 * np.log10(taps / samples * (band_hz[1] - band_hz[0]) / (rate_hz / 2))
