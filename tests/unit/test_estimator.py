"""Green's functions from records with a known truth."""

import dataclasses

import numpy as np
import pytest
import scipy.fft

from tests.system import raw_script
from wavefocus.acquisition.judgement import judge
from wavefocus.calibration.estimator.estimate import Channels
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.excitation import PlayedExcitation, RecordedExcitation
from wavefocus.calibration.known_signal import ReferenceMissingError
from wavefocus.config.run import QualityLimits
from wavefocus.storage.bank.ledger import Status
from wavefocus.storage.errors import InputError

# A quarter of the default in every length, for quick tests.
SMALL = PlayedExcitation(10_000.0, 40.0, 800.0, 0.3, 0.06, 1.0, 3)
TAPS = 500
ESTIMATOR = SequentialEstimator(SMALL, TAPS)
RANGE = (10.0, 200.0)


def damped_modes(records, taps, excitation, seed=0):
    draw = np.random.default_rng(seed)
    time_s = np.arange(taps) / excitation.sample_rate_hz
    slowest = 6 / time_s[-1]
    green = np.zeros((records, taps))
    for record in range(records):
        for hertz in draw.uniform(*excitation.band_hz, 24):
            decay = np.exp(-draw.uniform(1, 2.5) * slowest * time_s)
            green[record] += draw.standard_normal() * decay * np.sin(2 * np.pi * hertz * time_s)
    return green


def random_filters(records, taps, seed=1):
    return np.random.default_rng(seed).standard_normal((records, taps))


def played(signal, samples, offset, ratio):
    """Recordings (records, samples) of playback-clock signals (records, n), silence around them."""
    length = scipy.fft.next_fast_len(signal.shape[1] + 4000, real=True)
    fine = 16 * scipy.fft.irfft(scipy.fft.rfft(signal, length), 16 * length)
    place = 16 * (np.arange(samples) - offset) / ratio
    whole = np.floor(place).astype(int)
    share = place - whole
    out = np.zeros((signal.shape[0], samples))
    for node in range(-2, 4):
        weight = np.ones(samples)
        for other in range(-2, 4):
            if other != node:
                weight *= (share - other) / (node - other)
        out += weight * fine[:, (whole + node) % fine.shape[1]]
    return out


@dataclasses.dataclass
class Records:
    """Reference and response of a batch, and the rms of the response's noise."""

    reference: np.ndarray
    response: np.ndarray
    noise_v: np.ndarray

    def estimate(self, estimator=ESTIMATOR):
        return estimator.estimate(self.reference.astype(np.float32), self.response.astype(np.float32), range_v=RANGE)


def records_of(
    green, excitation=SMALL, *, snr_db=40.0, offset=100.4, ppm=0.0, post_roll=300, seed=5, response_late=0.0
):
    """Records of a linear plate: drive convolved on the playback clock, both channels then on the DAQ's."""
    draw = np.random.default_rng(seed)
    signal = np.tile(excitation.base_v(), excitation.averages)
    length = scipy.fft.next_fast_len(signal.size + green.shape[1], real=True)
    response = scipy.fft.irfft(scipy.fft.rfft(green, length) * scipy.fft.rfft(signal, length), length)
    samples = int(offset) + signal.size + post_roll
    ratio = 1 + 1e-6 * ppm
    x = played(signal[None], samples, offset, ratio)
    # A channel that is sampled late meets each event at an earlier sample.
    y = played(response[:, : signal.size + green.shape[1] - 1], samples, offset - response_late, ratio)
    noise_v = np.zeros(green.shape[0])
    x = np.repeat(x, green.shape[0], axis=0)
    if snr_db is not None:
        noise_v = np.sqrt((y[:, int(offset) : int(offset) + signal.size] ** 2).mean(axis=1)) * 10 ** (-snr_db / 20)
        x += 1e-3 * np.sqrt((signal**2).mean()) * draw.standard_normal(x.shape)
        y += noise_v[:, None] * draw.standard_normal(y.shape)
    return Records(x, y, noise_v)


def error_db(found, truth, excitation=SMALL):
    return raw_script.error_db(found, truth, excitation.sample_rate_hz, excitation.band_hz)


def limit_db(records, truth, excitation=SMALL):
    """Error that noise of -40 dB must leave, to a decibel or two."""
    samples, rate_hz = records.response.shape[1], excitation.sample_rate_hz
    return raw_script.noise_limit_db(samples, truth.shape[1], excitation.band_hz, rate_hz, 40.0)


@pytest.mark.parametrize(("kind", "ppm"), [("modes", 200.0), ("random", 0.0)])
def test_error_is_the_noise_limit_at_any_clock_ratio(kind, ppm):
    truth = damped_modes(12, TAPS, SMALL) if kind == "modes" else random_filters(12, TAPS)
    records = records_of(truth, ppm=ppm)
    estimate = records.estimate()
    assert estimate.offset_samples == pytest.approx(np.full(12, 100.4), abs=0.01)
    # A record of a third of the default's length tells the ratio a tenth as well.
    assert 1e6 * (estimate.clock_ratio - 1) == pytest.approx(np.full(12, ppm), abs=1.0)
    assert (error_db(estimate.green, truth) - limit_db(records, truth)).max() < 3.5


def test_many_sweeps_of_a_wide_band_are_found_at_their_start_at_minus_200_ppm():
    long = dataclasses.replace(SMALL, stop_hz=4000.0, averages=4)
    estimator = SequentialEstimator(long, 60)
    for post_roll in (300, 4000):  # the later one has room for a sweep more
        estimate = records_of(damped_modes(1, 60, long), long, ppm=-200.0, post_roll=post_roll).estimate(estimator)
        assert estimate.offset_samples == pytest.approx([100.4], abs=0.01)


@pytest.mark.parametrize("averages", [1, 3])
def test_coupling_capacitors_do_not_pass_for_a_clock(averages):
    played_thus = dataclasses.replace(SMALL, averages=averages)
    truth = damped_modes(4, TAPS, SMALL)
    records = records_of(truth, played_thus, snr_db=None, ppm=30.0)
    for channel in (records.reference, records.response):
        hertz = scipy.fft.rfftfreq(2 * channel.shape[1], 1 / SMALL.sample_rate_hz)
        passed = scipy.fft.rfft(channel, 2 * channel.shape[1]) * (1 - 1 / (1 + 1j * hertz / 5.0))
        channel[:] = scipy.fft.irfft(passed, 2 * channel.shape[1])[:, : channel.shape[1]]
    estimate = records.estimate(SequentialEstimator(played_thus, TAPS))
    assert 1e6 * (estimate.clock_ratio - 1) == pytest.approx(np.full(4, 30.0), abs=3)
    assert error_db(estimate.green, truth).max() < -70


def test_delay_between_channels_gain_and_response_unit_are_undone():
    truth = damped_modes(4, TAPS, SMALL)
    records = records_of(truth, snr_db=None, response_late=0.4)
    records.reference *= 0.8
    records.response /= 0.005
    estimator = SequentialEstimator(SMALL, TAPS, Channels(0.8, 0.005, 0.4 / SMALL.sample_rate_hz))
    assert error_db(records.estimate(estimator).green, truth).max() < -80


def test_single_sweep_gives_a_response_but_says_nothing_of_repeats():
    once = dataclasses.replace(SMALL, averages=1)
    truth = damped_modes(4, TAPS, once)
    records = records_of(truth, once, ppm=100.0)
    estimate = records.estimate(SequentialEstimator(once, TAPS))
    assert np.median(error_db(estimate.green, truth, once) - limit_db(records, truth, once)) < 2.5
    assert np.isnan(estimate.coherence).all()


def test_noise_ratios_and_samples_at_the_end_of_the_range_are_told_as_they_are():
    truth = damped_modes(12, TAPS, SMALL)
    records = records_of(truth)
    estimate = records.estimate()
    assert np.median(estimate.noise_v / records.noise_v) == pytest.approx(1, abs=0.05)
    assert estimate.peak_v == pytest.approx(np.abs(records.response).max(axis=1), rel=1e-6)
    # White noise spread over 5 kHz, of which the band holds 0.76 kHz; three repeats; sweeps 5/6 of the time.
    assert np.median(estimate.snr_db) == pytest.approx(40 + 10 * np.log10(5 / 0.76 * 3), abs=1.5)
    assert np.median(estimate.residual_db) == pytest.approx(-np.median(estimate.snr_db), abs=2)
    assert (estimate.coherence > 0.999).all()
    assert (estimate.clip_count == 0).all()
    records.reference[0, 10] = -RANGE[0]
    records.response[0, 20:23] = 0.9995 * RANGE[1]
    records.response[1] = 1e-3 * np.random.default_rng(2).standard_normal(records.response.shape[1])
    changed = records.estimate()
    assert changed.clip_count.tolist() == [4] + [0] * 11
    assert changed.coherence[1] == pytest.approx(1 / SMALL.averages, abs=0.03)


def test_the_same_record_gives_the_same_bytes_whatever_came_before():
    records = records_of(damped_modes(3, TAPS, SMALL))
    first = SequentialEstimator(SMALL, TAPS)
    records_of(random_filters(3, TAPS), ppm=-200.0).estimate(first)
    assert records.estimate(first).green.tobytes() == records.estimate(SequentialEstimator(SMALL, TAPS)).green.tobytes()


def lose_samples(records):
    gap = 700 + 2 * SMALL.period_samples - 5
    for channel in (records.reference, records.response):
        channel[:, gap + 7 :] = channel[:, gap:-7].copy()
        channel[:, gap : gap + 7] = 0


def lose_the_reference(records):
    records.reference[1] = np.random.default_rng(0).standard_normal(records.reference.shape[1])


def cut(begin, end):
    def change(records):
        records.reference, records.response = records.reference[:, begin:end], records.response[:, begin:end]

    return change


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lose_samples, "record 0.*lost samples"), (lose_the_reference, "record 1 "), (cut(0, -500), "record 0 "),
        (cut(900, None), "record 0 "), (cut(600, None), None),
    ],
)  # fmt: skip
def test_records_without_the_whole_reference_or_not_played_by_one_clock_are_named(spoil, told):
    records = records_of(damped_modes(3, TAPS, SMALL), ppm=50.0, offset=700.0)
    spoil(records)
    if told is None:
        assert records.estimate().offset_samples == pytest.approx([100.0] * 3, abs=0.01)
        return
    with pytest.raises(ReferenceMissingError, match=told):
        records.estimate()


def repeated_signals():
    """One repeat of signals that fill the band of `SMALL` and are no sweeps; rising, noisy, sparse, all at once."""
    samples, rate_hz = round(SMALL.duration_s * SMALL.sample_rate_hz), SMALL.sample_rate_hz
    hertz = np.fft.rfftfreq(samples, 1 / rate_hz)
    inside, draw = (hertz >= SMALL.start_hz) & (hertz <= SMALL.stop_hz), np.random.default_rng(3)
    line = np.cumsum(inside)
    phases = {
        "Schroeder multisine": -np.pi * line**2 / line[-1],
        "sparse multisine": draw.uniform(0, 2 * np.pi, hertz.size),
        "noise": draw.uniform(0, 2 * np.pi, hertz.size),
        "pulse": np.pi * np.arange(hertz.size),
    }
    amplitude = {"sparse multisine": line % 3 == 0, "noise": draw.rayleigh(size=hertz.size)}
    return {
        name: scipy.fft.irfft(inside * amplitude.get(name, 1.0) * np.exp(1j * phase), samples)
        for name, phase in phases.items()
    }


@pytest.mark.parametrize("name", repeated_signals())
def test_any_repeated_excitation_of_the_band_is_estimated(name):
    ppm = -480.0
    signal = repeated_signals()[name]
    base_v = np.pad(signal / np.abs(signal).max(), (0, SMALL.decay_samples))
    excitation = RecordedExcitation(base_v, SMALL.sample_rate_hz, *SMALL.band_hz, SMALL.decay_samples, SMALL.averages)
    truth = damped_modes(2, TAPS, SMALL)
    estimate = records_of(truth, excitation, ppm=ppm, snr_db=None).estimate(SequentialEstimator(excitation, TAPS))
    assert 1e6 * (estimate.clock_ratio - 1) == pytest.approx([ppm, ppm], abs=2)
    assert error_db(estimate.green, truth).max() < -60


@pytest.mark.parametrize("cut", [False, True], ids=["square term", "cut before the noise"])
def test_what_bends_where_no_third_harmonic_can_be_measured_is_unexplained(cut):
    time_s = np.arange(TAPS) / SMALL.sample_rate_hz
    low = np.exp(-120 * time_s) * np.sin(2 * np.pi * np.array([[62.0], [75.0], [88.0]]) * time_s)
    records = records_of(low, snr_db=None)
    peak_v = np.abs(records.response).max(axis=1, keepdims=True)
    if cut:
        records.response = np.clip(records.response, -0.93 * peak_v, 0.93 * peak_v)
    else:
        records.response += 0.02 * records.response**2 / peak_v
    records.response += 1e-3 * peak_v * np.random.default_rng(2).standard_normal(records.response.shape)
    estimate = records.estimate()
    assert np.isnan(estimate.defects["harmonic_db"]).all()
    judgement = judge(estimate, False, QualityLimits())
    assert {defect.name for defect in judgement.defects} == {"unexplained"}
    assert judgement.status == Status.POOR_SIGNAL
    assert "sweep.amplitude_v" in judgement.reason


def test_records_that_cannot_be_are_refused():
    records = np.zeros((2, 12_000), dtype=np.float32)
    for reference, response in (
        (records[0], records[0]),
        (records, records[:1]),
        (records[:, :5000], records[:, :5000]),
        (records[:0], records[:0]),
        (np.full_like(records, np.nan), records),
    ):
        with pytest.raises(InputError):
            ESTIMATOR.estimate(reference, response, range_v=RANGE)


@pytest.mark.nightly
def test_given_an_audio_band_then_a_clock_that_turns_the_phases_many_times_is_found():
    ppm = -300.0
    audio = PlayedExcitation(48_000.0, 50.0, 18_000.0, 0.8, 0.1, 1.0, 2)
    truth = damped_modes(2, 4000, audio)
    estimate = records_of(truth, audio, snr_db=50.0, offset=300.4, ppm=ppm).estimate(SequentialEstimator(audio, 4000))
    assert 1e6 * (estimate.clock_ratio - 1) == pytest.approx(np.full(2, ppm), abs=0.1)
    assert error_db(estimate.green, truth, audio).max() < -54
