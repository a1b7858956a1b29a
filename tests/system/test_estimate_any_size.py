"""Recordings of audio rates, of long responses, and of one clock, as other laboratories write them."""

from __future__ import annotations

from dataclasses import dataclass

import h5py
import numpy as np
import pytest
import scipy.signal

from wavefocus.__main__ import run
from wavefocus.calibration.estimator.raw_estimation import affordable_workers
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.writer import open_raw

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


def swept(sweep, green, rate_hz, ppm, *, delays_s=None, tail_s, start_s=0.03, snr_db=40.0, seed=1):
    """Reference and response of one record (samples,): rows of `green` play together, each so much later."""
    draw = np.random.default_rng(seed)
    delays_s = np.zeros(len(green)) if delays_s is None else delays_s
    samples = round((start_s + sweep.duration_s + max(delays_s) + tail_s) * rate_hz)
    time_s = np.arange(samples) / (rate_hz * (1 + 1e-6 * ppm)) - start_s
    reference, response = sweep(time_s), np.zeros(samples)
    for row, delay_s in zip(green, delays_s, strict=True):
        for tap in np.flatnonzero(row):
            response += row[tap] * sweep(time_s - delay_s - tap / rate_hz)
    reference += 1e-3 * reference.std() * draw.standard_normal(samples)
    return reference, response + 10 ** (-snr_db / 20) * response.std() * draw.standard_normal(samples)


def write(path, records, taps, rate_hz, band_hz, *, slots=None, said=None):
    """A raw file of one position; `slots` of each record are (actuators, delays_s), by default one after the other."""
    slots = slots or [([record], [0.0]) for record in range(len(records))]
    with h5py.File(path, "w") as file:
        file.attrs.update(
            {
                "format": "wavefocus-raw", "format_version": 1, "sample_rate_hz": rate_hz, "taps": taps,
                "band_hz": band_hz, "response_per_volt": 1.0, "response_unit": "m/s", "reference_gain": 1.0,
                "inter_channel_delay_s": 0.0, "period_s": 0.0, **(said or {}),
            }
        )  # fmt: skip
        file["reference"] = np.array([[one[0] for one in records]], dtype=np.float32)
        file["response"] = np.array([[one[1] for one in records]], dtype=np.float32)
        file["schedule/actuator"] = np.array([one[0] for one in slots], dtype=np.int32)
        file["schedule/delay_s"] = np.array([one[1] for one in slots])
        file["schedule/gain"] = np.ones((len(slots), len(slots[0][0])))
        file["position_mm"] = np.zeros((1, 2))
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


@pytest.mark.parametrize(
    ("rate_hz", "band_hz", "duration_s", "law", "taps"),
    [
        (44_100.0, (50.0, 22_050.0), 2.5, "linear", 300),
        (48_000.0, (20.0, 20_000.0), 3.0, "linear", 12_000),
        (48_000.0, (100.0, 16_000.0), 1.0, "linear", 500),
    ],
    ids=["44.1 kHz, 300 taps", "48 kHz, 12000 taps", "48 kHz, 500 taps"],
)
def test_given_a_sweep_of_which_nothing_is_said_then_the_noise_is_the_limit(
    tmp_path, rate_hz, band_hz, duration_s, law, taps
):
    truth = echoes(2, taps)
    sweep = Sweep(band_hz, duration_s, law)
    records = [swept(sweep, row[None], rate_hz, 37.0, tail_s=taps / rate_hz + 0.03) for row in truth]
    raw = write(tmp_path / "a.raw.h5", records, taps, rate_hz, band_hz)
    error = error_db(estimated(raw, tmp_path / "bank.h5"), truth, rate_hz, band_hz)
    assert error.max() < noise_limit_db(records[0][0].size, taps, band_hz, rate_hz, 40.0) + 2.5


def test_given_an_exponential_sweep_of_a_stated_law_then_it_is_estimated(tmp_path):
    truth, band_hz = echoes(1, 4_000), (50.0, 16_000.0)
    record = swept(Sweep(band_hz, 1.0, "exponential"), truth, 48_000.0, -60.0, tail_s=0.12)
    raw = write(tmp_path / "a.raw.h5", [record], 4_000, 48_000.0, band_hz, said={"sweep_law": "exponential"})
    # Its last fade leaves little above 15 kHz.
    assert error_db(estimated(raw, tmp_path / "bank.h5"), truth, 48_000.0, (100.0, 14_500.0)).max() < -44


def test_given_actuators_that_play_together_at_audio_rates_then_they_come_apart(tmp_path):
    taps, band_hz, delays_s = 12_000, (50.0, 18_000.0), [0.0, 0.3, 0.6]
    truth = echoes(3, taps)
    record = swept(Sweep(band_hz, 1.0), truth, 48_000.0, 31.0, delays_s=delays_s, tail_s=0.27)
    raw = write(tmp_path / "a.raw.h5", [record], taps, 48_000.0, band_hz, slots=[([0, 1, 2], delays_s)])
    assert error_db(estimated(raw, tmp_path / "bank.h5"), truth, 48_000.0, band_hz).max() < -40


@pytest.mark.parametrize(
    ("law", "said"),
    [("linear", {"sweep_law": "other"}), ("linear", {"sweep_law": "exponential"}), ("exponential", {})],
    ids=["another law stated", "the wrong law stated", "exponential, not stated"],
)
def test_a_sweep_that_does_not_follow_the_stated_law_then_exit_2_names_the_remedy(tmp_path, capsys, law, said):
    record = swept(Sweep((50.0, 4_000.0), 1.0, law), echoes(1, 500), 10_000.0, 0.0, tail_s=0.1)
    raw = write(tmp_path / "a.raw.h5", [record], 500, 10_000.0, (50.0, 4_000.0), said=said)
    assert run(["estimate", str(raw), "--bank", str(tmp_path / "bank.h5")]) == 2
    message = capsys.readouterr().err
    assert "same_clock" in message
    assert "sweep_law" in message
    assert not (tmp_path / "bank.h5").exists()


def heard(excitation, green, snr_db, draw, first=0):
    """Reference and response of one clock, from sample `first` on."""
    response = scipy.signal.fftconvolve(excitation, green)[first : excitation.size]
    response += 10 ** (-snr_db / 20) * response.std() * draw.standard_normal(response.size)
    return excitation[first:], response


@pytest.mark.parametrize("kind", ["noise", "running noise", "sweep of no law"])
def test_given_one_clock_then_any_long_recording_is_estimated(tmp_path, kind):
    rate_hz, band_hz, taps, samples = 48_000.0, (50.0, 20_000.0), 4_000, 100_000
    draw, truth, first = np.random.default_rng(2), echoes(2, taps), 0
    records = []
    for row in truth:
        if kind == "sweep of no law":
            phase = np.cumsum(np.interp(np.arange(samples), [0, 3e4, 9e4, 1e5], [100, 21e3, 40, 40])) / rate_hz
            excitation = np.sin(2 * np.pi * phase) * (np.arange(samples) < 9e4)
        else:
            excitation = draw.standard_normal(samples)
            first = taps if kind == "running noise" else 0
        records.append(heard(excitation, row, 50.0, draw, first))
    raw = write(tmp_path / "a.raw.h5", records, taps, rate_hz, band_hz, said={"same_clock": True})
    error = error_db(estimated(raw, tmp_path / "bank.h5"), truth, rate_hz, (200.0, 19_000.0))
    assert error.max() < noise_limit_db(samples, taps, band_hz, rate_hz, 50.0) + 2.0


def test_given_hammer_hits_of_different_strength_then_they_are_estimated_together(tmp_path):
    rate_hz, band_hz, taps = 48_000.0, (50.0, 6_000.0), 4_000
    draw, truth, records = np.random.default_rng(3), echoes(2, taps), []
    for row, strength in ((0, 1.0), (0, 0.3), (0, 2.0), (1, 1.0), (1, 0.5)):
        excitation = np.zeros(20_000)
        begin = int(draw.integers(500, 5_000))
        excitation[begin : begin + 8] = strength * np.hanning(8)
        records.append(heard(excitation, truth[row], 40.0, draw))
    slots = [([row], [0.0]) for row in (0, 0, 0, 1, 1)]
    raw = write(tmp_path / "a.raw.h5", records, taps, rate_hz, band_hz, slots=slots, said={"same_clock": True})
    assert error_db(estimated(raw, tmp_path / "bank.h5"), truth, rate_hz, band_hz).max() < -42


def test_given_one_clock_and_a_periodic_noise_then_staggered_actuators_come_apart(tmp_path):
    rate_hz, taps, period = 10_000.0, 200, 4_000
    draw, truth = np.random.default_rng(4), echoes(3, taps)
    band_hz = (100.0, 2_000.0)
    spectrum = np.zeros(period // 2 + 1, complex)
    spectrum[40:801] = np.exp(2j * np.pi * draw.random(761))
    base = np.fft.irfft(spectrum, period)
    shifts = [0, 1_000, 2_000]
    response = sum(
        np.fft.irfft(np.fft.rfft(np.roll(base, shift)) * np.fft.rfft(row, period), period)
        for shift, row in zip(shifts, truth, strict=True)
    )
    record = (np.tile(base, 2), np.tile(response, 2) + 1e-3 * response.std() * draw.standard_normal(2 * period))
    slots = [([0, 1, 2], [shift / rate_hz for shift in shifts])]
    said = {"same_clock": True, "period_s": period / rate_hz}
    raw = write(tmp_path / "a.raw.h5", [record], taps, rate_hz, band_hz, slots=slots, said=said)
    assert error_db(estimated(raw, tmp_path / "bank.h5"), truth, rate_hz, band_hz).max() < -45


@pytest.mark.parametrize("said", [{"same_clock": 2}, {"same_clock": "yes"}, {"sweep_law": "quadratic"}])
def test_given_an_attribute_of_no_meaning_then_exit_2(tmp_path, said):
    raw = write(tmp_path / "a.raw.h5", [(np.ones(100), np.ones(100))], 10, 1000.0, (50.0, 400.0), said=said)
    assert run(["estimate", str(raw), "--bank", str(tmp_path / "bank.h5")]) == 2


def test_given_more_than_memory_holds_then_it_is_refused_before_a_sample_is_read(tmp_path):
    raw = write(tmp_path / "a.raw.h5", [(np.ones(100), np.ones(100))], 10, 1000.0, (50.0, 400.0))
    with h5py.File(raw, "a") as file:
        for name in ("reference", "response"):
            del file[name]
            file.create_dataset(name, (1, 1, 100_000_000), np.float32, chunks=(1, 1, 1 << 20))
    with open_raw(raw) as recordings, pytest.raises(InputError, match="GiB of memory"):
        affordable_workers(recordings.header, 2, str(raw), present=4 << 30)
    with open_raw(raw) as recordings:
        assert affordable_workers(recordings.header, 8, str(raw), present=64 << 30) == 1
