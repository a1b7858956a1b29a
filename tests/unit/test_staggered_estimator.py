"""Joint estimation of actuators that sound together, against truth and against the noise's own limit."""

from functools import cache

import numpy as np
import pytest
import scipy.fft
from hypothesis import given, settings
from hypothesis import strategies as st

from wavefocus.calibration.estimator.estimate import Channels, Records
from wavefocus.calibration.estimator.staggered import StaggeredEstimator
from wavefocus.calibration.excitation import PlayedExcitation, StaggeredSignal
from wavefocus.calibration.known_signal import ReferenceMissingError
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.header import Schedule

RATE_HZ = 2000.0
BAND_HZ = (20.0, 400.0)
TAPS = 100
SWEEP = PlayedExcitation(RATE_HZ, *BAND_HZ, 0.5, 0.05, 1.0, 1)
SIGNAL = StaggeredSignal(SWEEP, actuators=5, taps=TAPS, stagger_samples=120)


def played(base_v, delays, green, ppm, start, samples):
    """Both channels at the DAQ's instants: a periodic signal is a Fourier series, which knows any instant."""
    period = base_v.size
    ring = np.zeros(period)
    for one, delay in zip(green, delays, strict=True):
        ring[(delay + np.arange(TAPS)) % period] += one
    series = scipy.fft.rfft(base_v) * 2 / period
    instants = np.arange(samples) / (1 + 1e-6 * ppm) - start
    turns = np.exp(2j * np.pi / period * np.outer(instants, np.arange(series.size - 1)))
    reference = (turns @ series[:-1]).real - series[0].real / 2
    return reference, (turns @ (series * scipy.fft.rfft(ring))[:-1]).real


def in_band(green):
    hertz = np.fft.rfftfreq(4 * TAPS, 1 / RATE_HZ)
    return np.fft.rfft(green, 4 * TAPS)[:, (hertz >= BAND_HZ[0]) & (hertz <= BAND_HZ[1])]


def error_db(found, true):
    wrong, right = in_band(found - true), in_band(true)
    return 10 * np.log10((np.abs(wrong) ** 2).sum(axis=1) / (np.abs(right) ** 2).sum(axis=1))


def random_firs(seed):
    draw = np.random.default_rng(seed)
    return draw.standard_normal((5, TAPS)) * np.exp(-np.arange(TAPS) / 30)


RECORDS = Records(RATE_HZ, BAND_HZ, TAPS, SIGNAL.schedule(), Channels(response_per_volt=0.5))
ESTIMATOR = StaggeredEstimator(SIGNAL.base_v(), RECORDS)


def estimated(reference, response):
    """Of one record."""
    channels = (one[None].astype(np.float32) for one in (reference, response))
    return ESTIMATOR.estimate(*channels, range_v=(1e3, 1e3))


@cache
def least_noise():
    """Energy in band that noise of 1 V leaves in each FIR by least squares with the true drives, in expectation."""
    base_v, samples = SIGNAL.base_v(), SIGNAL.used_samples
    columns = [np.roll(base_v, 120 * slot + tap) for slot in range(5) for tap in range(TAPS)]
    matrix = np.resize(np.stack(columns), (5 * TAPS, base_v.size))
    matrix = np.concatenate([matrix, matrix], axis=1)[:, :samples].T / 0.5
    covariance = np.linalg.pinv(matrix.T @ matrix, rcond=1e-8, hermitian=True)[:TAPS, :TAPS]
    fourier = in_band(np.eye(TAPS)).T
    return float(np.sum((fourier @ covariance) * fourier.conj()).real)


def limit_db(true, noise_v):
    """The error that noise alone must leave."""
    return 10 * np.log10(noise_v**2 * least_noise() / (np.abs(in_band(true)) ** 2).sum(axis=1))


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), ppm=st.floats(-200, 200), start=st.floats(0, 599))
def test_any_firs_offset_and_skew_come_back_within_1_5_db_of_the_noise_s_own_limit(seed, ppm, start):
    green = random_firs(seed)
    reference, response = played(SIGNAL.base_v(), [120 * k for k in range(5)], green, ppm, start, SIGNAL.used_samples)
    draw = np.random.default_rng(seed + 1)
    noise_v, above_db = 0.02, []
    # The limit is one of means: what a single noise leaves of one FIR scatters about it by some decibels.
    for _ in range(16):
        noisy = response / 0.5 + noise_v * draw.standard_normal(response.size)
        found = estimated(reference, noisy)
        above_db.append(error_db(found.green, green) - limit_db(green, noise_v))
        assert found.clock_ratio[0] == pytest.approx(1 + 1e-6 * ppm, abs=2e-6)
    assert 10 * np.log10(np.mean(10 ** (np.array(above_db) / 10))) <= 1.5


def test_given_groups_then_each_record_gives_its_own_actuators_in_order():
    signal = StaggeredSignal(SWEEP, actuators=5, taps=TAPS, stagger_samples=120, groups=2)
    green, schedule = random_firs(3), signal.schedule()
    estimator = StaggeredEstimator(signal.base_v(), Records(RATE_HZ, BAND_HZ, TAPS, schedule))
    channels = []
    for record in range(2):
        actuator, delay_s, _ = schedule.slots(record)
        delays = np.round(delay_s * RATE_HZ).astype(int).tolist()
        channels.append(played(signal.base_v(), delays, green[actuator], 30.0, 10.0, signal.used_samples))
    reference_v, response_v = (np.stack([one[row] for one in channels]).astype(np.float32) for row in range(2))
    found = estimator.estimate(reference_v, response_v, range_v=(1e3, 1e3))
    assert error_db(found.green, green).max() < -45


def test_given_uneven_delays_then_each_actuator_comes_back():
    delays = [0, 107, 231, 352, 479]
    schedule = Schedule(np.arange(5)[None], np.array([delays]) / RATE_HZ, np.ones((1, 5)), 600 / RATE_HZ)
    estimator = StaggeredEstimator(SIGNAL.base_v(), Records(RATE_HZ, BAND_HZ, TAPS, schedule))
    green = random_firs(6)
    channels = played(SIGNAL.base_v(), delays, green, 30.0, 10.0, SIGNAL.used_samples)
    found = estimator.estimate(*(one[None].astype(np.float32) for one in channels), range_v=(1e3, 1e3))
    assert error_db(found.green, green).max() < -45


def test_given_a_moment_without_light_then_the_residual_names_it():
    green = random_firs(4)
    reference, response = played(SIGNAL.base_v(), [120 * k for k in range(5)], green, 0.0, 0.0, SIGNAL.used_samples)
    response = response / 0.5
    response += 1e-3 * np.random.default_rng(5).standard_normal(response.size)
    sound = estimated(reference, response)
    response[200:210] = 0.0
    spoilt = estimated(reference, response)
    assert sound.defects["burst_db"][0] < -60
    assert spoilt.defects["burst_db"][0] > -40
    assert spoilt.residual_db[0] > sound.residual_db[0] + 15


def test_given_a_silent_reference_then_it_is_missing():
    noise = np.random.default_rng(0).standard_normal(SIGNAL.used_samples).astype(np.float32)
    with pytest.raises(ReferenceMissingError, match="does not carry"):
        estimated(noise, noise)


def test_given_less_than_a_period_then_the_record_is_refused():
    short = np.zeros(500, np.float32)
    with pytest.raises(InputError, match="less than the period of 600"):
        estimated(short, short)


def test_given_slots_that_overlap_then_they_are_refused():
    schedule = Schedule(np.array([[0, 1]]), np.array([[0.0, 50 / RATE_HZ]]), np.ones((1, 2)), 600 / RATE_HZ)
    with pytest.raises(InputError, match="allowed is 1 to the distance of two slots, 50"):
        StaggeredEstimator(SIGNAL.base_v(), Records(RATE_HZ, BAND_HZ, TAPS, schedule))


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"groups": 6}, "groups is 6; allowed is 1 to the number of actuators, 5"),
        ({"periods": 0}, "periods is 0"),
        ({"taps": 121}, "taps is 121; allowed is 1 to a stagger, 120 samples"),
        ({"stagger_samples": 100, "taps": 1, "groups": 5, "actuators": 5}, None),
    ],
)
def test_a_staggered_signal_refuses_what_cannot_be_played(changes, complaint):
    asked = {"actuators": 5, "taps": TAPS, "stagger_samples": 120, **changes}
    if complaint is None:
        assert StaggeredSignal(SWEEP, **asked).slots == 1
        return
    with pytest.raises(InputError, match=complaint):
        StaggeredSignal(SWEEP, **asked)


@pytest.mark.parametrize(
    ("actuator", "delay_s", "gain", "period_s", "complaint"),
    [
        ([[0, 0]], [[0, 0.1]], [[1, 1]], 1.0, "plays actuator 0 twice in record 0"),
        ([[0, 2]], [[0, 0.1]], [[1, 1]], 1.0, "never plays actuator 1"),
        ([[0], [-1]], [[0], [0]], [[1], [1]], 0.0, "plays nothing in record 1"),
        ([[0, 1]], [[0, 1.0]], [[1, 1]], 1.0, "less than period_s = 1"),
        ([[0, 1]], [[0, -0.1]], [[1, 1]], 1.0, "0 or more is needed"),
        ([[0, 1]], [[0, 0.1]], [[1, 0]], 1.0, "each slot needs a gain"),
        ([[0, 1]], [[0, 0.1]], [[1, 1]], -1.0, "0 or a period in seconds"),
    ],
)
def test_a_schedule_that_cannot_be_is_refused(actuator, delay_s, gain, period_s, complaint):
    with pytest.raises(InputError, match=complaint):
        Schedule(np.array(actuator), np.array(delay_s), np.array(gain), period_s)
