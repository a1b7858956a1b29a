"""Joint estimation of actuators that sound together, against truth."""

import numpy as np
import pytest
import scipy.fft

from tests.system.raw_script import error_db
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


def random_firs(seed):
    draw = np.random.default_rng(seed)
    return draw.standard_normal((5, TAPS)) * np.exp(-np.arange(TAPS) / 30)


RECORDS = Records(RATE_HZ, BAND_HZ, TAPS, SIGNAL.schedule(), Channels(response_per_volt=0.5))
ESTIMATOR = StaggeredEstimator(SIGNAL.base_v(), RECORDS)


def estimated(reference, response):
    """Of one record."""
    channels = (one[None].astype(np.float32) for one in (reference, response))
    return ESTIMATOR.estimate(*channels, range_v=(1e3, 1e3))


UNEVEN = Schedule(np.arange(5)[None], np.array([[0, 107, 231, 352, 479]]) / RATE_HZ, np.ones((1, 5)), 600 / RATE_HZ)
GROUPS = StaggeredSignal(SWEEP, actuators=5, taps=TAPS, stagger_samples=120, groups=2)


@pytest.mark.parametrize(
    ("schedule", "base_v", "ppm", "start"),
    [
        (SIGNAL.schedule(), SIGNAL.base_v(), 200.0, 598.7),
        (SIGNAL.schedule(), SIGNAL.base_v(), -200.0, 0.0),
        (GROUPS.schedule(), GROUPS.base_v(), 30.0, 10.0),
        (UNEVEN, SIGNAL.base_v(), 30.0, 10.0),
    ],
    ids=["even delays", "a slow clock", "groups", "uneven delays"],
)
def test_given_any_schedule_offset_and_skew_then_each_actuator_comes_back_in_order(schedule, base_v, ppm, start):
    green, channels = random_firs(3), []
    for record in range(len(schedule.actuator)):
        actuator, delay_s, _ = schedule.slots(record)
        delays = np.round(delay_s * RATE_HZ).astype(int).tolist()
        channels.append(played(base_v, delays, green[actuator], ppm, start, SIGNAL.used_samples))
    reference_v, response_v = (np.stack([one[row] for one in channels]).astype(np.float32) for row in range(2))
    estimator = StaggeredEstimator(base_v, Records(RATE_HZ, BAND_HZ, TAPS, schedule))
    found = estimator.estimate(reference_v, response_v, range_v=(1e3, 1e3))
    assert found.clock_ratio[0] == pytest.approx(1 + 1e-6 * ppm, abs=2e-6)
    assert error_db(found.green, green, RATE_HZ, BAND_HZ).max() < -45


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


@pytest.mark.parametrize(
    ("record_v", "error", "told"),
    [
        (np.random.default_rng(0).standard_normal(SIGNAL.used_samples), ReferenceMissingError, "does not carry"),
        (np.zeros(500), InputError, "less than the period of 600"),
    ],
    ids=["a silent reference", "less than a period"],
)
def test_a_record_that_cannot_be_estimated_is_refused(record_v, error, told):
    with pytest.raises(error, match=told):
        estimated(record_v, record_v)


def test_given_slots_that_overlap_then_they_are_refused():
    schedule = Schedule(np.array([[0, 1]]), np.array([[0.0, 50 / RATE_HZ]]), np.ones((1, 2)), 600 / RATE_HZ)
    with pytest.raises(InputError, match="allowed is 1 to the distance of two slots, 50"):
        StaggeredEstimator(SIGNAL.base_v(), Records(RATE_HZ, BAND_HZ, TAPS, schedule))


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
