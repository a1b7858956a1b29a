"""Banks from raw recordings that an independent script wrote, of any rate, length and clock."""

import h5py
import numpy as np
import pytest
import scipy.signal

from tests.system.captures import held, refused, said_by, wavefocus
from tests.system.raw_script import Sweep, echoes, error_db, estimated, noise_limit_db, swept, write
from wavefocus.calibration.estimator.raw_estimation import affordable_workers
from wavefocus.estimation import estimate
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.writer import open_raw

RATE_HZ, BAND_HZ, TAPS = 5000.0, (50.0, 1000.0), 200
DELAYS_S = [0.0, 0.2, 0.4, 0.6]


def sequential(path, *, snr_db=40.0, **options):
    """A raw file of three actuators one after the other, and the truth."""
    truth = echoes(3, TAPS)
    records = [
        swept(Sweep(BAND_HZ, 0.8), row[None], RATE_HZ, 40.0, snr_db=snr_db, seed=seed) for seed, row in enumerate(truth)
    ]
    return write(path, records, TAPS, RATE_HZ, BAND_HZ, **options), truth


def staggered(path):
    """One of four actuators that play together, again and again, and the truth."""
    truth = echoes(4, TAPS)
    record = swept(Sweep(BAND_HZ, 0.8), truth, RATE_HZ, 40.0, delays_s=DELAYS_S, start_s=0.37, period_s=0.8)
    slots = [([0, 1, 2, 3], DELAYS_S)]
    return write(path, [record], TAPS, RATE_HZ, BAND_HZ, slots=slots, said={"period_s": 0.8}), truth


def as_counts(raw):
    """Keep whole numbers of steps, as a converter gives them."""
    with h5py.File(raw, "r+") as file:
        for name in ("reference", "response"):
            volts = file[name][...]
            step_v = 1.02 * np.abs(volts).max() / 32768
            del file[name]
            file[name] = np.round(volts / step_v).astype(np.int16)
            file[name].attrs["volts_per_count"] = step_v


@pytest.mark.parametrize(
    ("make", "together", "counts"),
    [(sequential, 1, False), (sequential, 1, True), (staggered, 4, True)],
    ids=["sequential float", "sequential int16", "staggered int16"],
)
def test_raw_recordings_by_another_program_then_the_noise_is_the_limit(tmp_path, make, together, counts):
    raw, truth = make(tmp_path / "a.raw.h5")
    if counts:
        as_counts(raw)
    error = error_db(estimated(raw, tmp_path / "bank.h5"), truth, RATE_HZ, BAND_HZ)
    with h5py.File(raw) as file:
        samples = file["response"].shape[-1]
    limit_db = noise_limit_db(samples, TAPS, BAND_HZ, RATE_HZ, 40.0) + 10 * np.log10(together)
    assert np.median(error) < limit_db + 2.5  # the fades of a sweep leave less at the edges of the band


def test_given_one_worker_or_two_then_the_bank_is_the_same_to_the_byte(tmp_path):
    raw, _ = sequential(tmp_path / "a.raw.h5", positions=3)
    seen = []
    for workers in (1, 2):
        estimate(raw, tmp_path / f"{workers}.h5", workers=workers, on_progress=lambda *one: seen.append(one)).close()
        assert seen[-1] == (3, 3)
    assert (tmp_path / "1.h5").read_bytes() == (tmp_path / "2.h5").read_bytes()


def test_a_position_that_holds_nan_fails_and_the_others_are_estimated(tmp_path, capsys):
    raw, _ = sequential(tmp_path / "a.raw.h5", positions=3)
    with h5py.File(raw, "r+") as file:
        file["response"][0, 1, 7] = np.nan
        for name in ("reference", "response"):  # not recorded yet, as other programs fill a file
            file[name][2] = np.full_like(file[name][2], np.nan)
    assert said_by(capsys, "estimate", raw, "--bank", tmp_path / "bank.h5").err.count("holds NaN or infinities") == 1
    assert held(tmp_path / "bank.h5") == [8, 1, 0]


@pytest.mark.parametrize(
    ("gain", "stated", "status"),
    [(1.0, 1.0, [1, 1]), (10 ** (-0.3 / 20), 1.0, [1, 4]), (0.5, 0.5, [1, 1])],
    ids=["level", "fainter in one position", "of another gain, as stated"],
)
def test_a_recording_with_a_fainter_reference_makes_its_position_poor(tmp_path, gain, stated, status):
    raw, _ = sequential(tmp_path / "a.raw.h5", snr_db=60.0, positions=2, said={"reference_gain": stated})
    with h5py.File(raw, "r+") as file:
        file["reference"][...] = stated * file["reference"][...]
        file["reference"][1, 2] = gain / stated * file["reference"][1, 2]
    assert wavefocus("estimate", raw, "--bank", tmp_path / "bank.h5") == 0
    assert held(tmp_path / "bank.h5") == status


@pytest.mark.parametrize(
    ("rate_hz", "band_hz", "duration_s", "taps"),
    [
        (44_100.0, (50.0, 22_050.0), 1.5, 300),
        pytest.param(48_000.0, (20.0, 20_000.0), 3.0, 12_000, marks=pytest.mark.nightly),
    ],
    ids=["44.1 kHz, 300 taps", "48 kHz, 12000 taps"],
)
def test_given_a_sweep_of_which_nothing_is_said_then_the_noise_is_the_limit(
    tmp_path, rate_hz, band_hz, duration_s, taps
):
    truth = echoes(2, taps)
    sweep = Sweep(band_hz, duration_s)
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


@pytest.mark.parametrize(
    ("law", "said"),
    [("linear", {"sweep_law": "other"}), ("linear", {"sweep_law": "exponential"}), ("exponential", {})],
    ids=["another law stated", "the wrong law stated", "exponential, not stated"],
)
def test_a_sweep_that_does_not_follow_the_stated_law_then_exit_2_names_the_remedy(tmp_path, capsys, law, said):
    record = swept(Sweep((50.0, 4_000.0), 1.0, law), echoes(1, 500), 10_000.0, 0.0, tail_s=0.1)
    raw = write(tmp_path / "a.raw.h5", [record], 500, 10_000.0, (50.0, 4_000.0), said=said)
    message = refused(capsys, "estimate", raw, "--bank", tmp_path / "bank.h5")
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
    rate_hz, band_hz, taps, samples = 48_000.0, (50.0, 20_000.0), 2_000, 50_000
    draw, truth, first = np.random.default_rng(2), echoes(2, taps), 0
    records = []
    for row in truth:
        if kind == "sweep of no law":
            phase = np.cumsum(np.interp(np.arange(samples), [0, 15e3, 45e3, 5e4], [100, 21e3, 40, 40])) / rate_hz
            excitation = np.sin(2 * np.pi * phase) * (np.arange(samples) < 45e3)
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


@pytest.mark.parametrize("said", [{"same_clock": 2}, {"same_clock": "yes"}, {"sweep_law": "quadratic"}, None])
def test_an_attribute_of_no_meaning_or_no_recording_then_exit_2_and_one_line(tmp_path, said, capsys):
    raw = tmp_path / "a.raw.h5"
    raw.write_bytes(b"nothing of the kind")
    if said is not None:
        write(raw, [(np.ones(100), np.ones(100))], 10, 1000.0, (50.0, 400.0), said=said)
    refused(capsys, "estimate", raw, "--bank", tmp_path / "bank.h5")
    assert not (tmp_path / "bank.h5").exists()


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
