"""What point quality sees in records of the virtual rig, with each defect put into one of them."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from tests.lab_files import setup_of
from wavefocus.acquisition.judgement import Cure, judge
from wavefocus.acquisition.setup import point_at, take_record
from wavefocus.calibration.estimator.estimate import Channels
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.config.run import QualityLimits
from wavefocus.drivers.protocols import RecordLabel
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.storage.bank.ledger import Status

RATE_HZ = 10_000.0
ACTUATORS = ((110.0, 0.0), (0.0, 60.0), (-110.0, 10.0), (60.0, -60.0))
POSITION_MM = (80.0, 4.0)
STRONG, WEAK = 0, 2
DISTANCE_MM = np.array([np.hypot(x - POSITION_MM[0], y - POSITION_MM[1]) for x, y in ACTUATORS])
RANGE_V = (10.0, 10.0)

Volts = tuple[np.ndarray, np.ndarray]
Spoil = Callable[[np.ndarray, np.ndarray], Volts]


@cache
def estimator(averages, taps):
    return SequentialEstimator(excitation(averages), taps, Channels(inter_channel_delay_s=5e-6))


def excitation(averages):
    return PlayedExcitation(RATE_HZ, 20.0, 500.0, 1.0, 0.2, 1.0, averages)


@cache
def quiet_records(averages):
    """Both channels of a record per actuator, without the vibrometer's noise and hardly rounded."""
    settings = VirtualSettings(seed=5, noise_v=0.0, dropout_probability=0.0, actuator_mm=ACTUATORS, gain_spread_db=0.0)
    rig = VirtualRig(settings)
    signal_v = excitation(averages).signal_v()
    taken = []
    for actuator, range_v in enumerate((5.0, 0.2, 0.01, 0.2)):
        setup = setup_of(rig, range_v=(10.0, range_v))
        point_at(setup, *POSITION_MM)
        signals_v = {actuator: signal_v, settings.channel_of_loopback: signal_v}
        taken.append(take_record(setup, signals_v, RATE_HZ, RecordLabel(0, 1, actuator)).volts)
    volts = np.stack(taken)
    return volts[:, 0], volts[:, 1]


def judged(spoil, record, *, snr_db=40.0, averages=3, taps=2000):
    """All records with the noise that gives one of them this ratio; that one spoilt before the noise is added."""
    reference, response = (channel.copy() for channel in quiet_records(averages))
    level_v = float(response[record].std()) * 10 ** (-snr_db / 20)
    if spoil is not None:
        reference[record], response[record] = spoil(reference[record], response[record])
    response += level_v * np.random.default_rng([averages, record]).normal(size=response.shape)
    estimate = estimator(averages, taps).estimate(reference, response.astype(np.float32), range_v=RANGE_V)
    return judge(estimate, False, QualityLimits(), DISTANCE_MM)


def clipped(reference, response):
    end_v = 0.95 * np.abs(response).max()
    return reference, np.clip(response, -end_v, end_v)


def one_less(samples):
    return np.concatenate([samples[:13_000], samples[13_001:], samples[-1:]])


def one_more(samples):
    return np.concatenate([samples[:13_000], samples[12_999:-1]])


def dropped_out(reference, response):
    spoilt = response.copy()
    spoilt[13_000:13_050] = 0.0
    return reference, spoilt


def fainter(level_db):
    """The second sweep of a record at another level."""

    def stepped(reference, response):
        spoilt = response.copy()
        spoilt[12_300:24_300] *= 10 ** (level_db / 20)
        return reference, spoilt

    return stepped


def early(spoil):
    """The same in the first sweep of a record."""

    def moved(reference, response):
        spoilt = spoil(np.roll(reference, 12_000), np.roll(response, 12_000))
        return np.roll(spoilt[0], -12_000), np.roll(spoilt[1], -12_000)

    return moved


def humming(line_hz):
    def hum(reference, response):
        tone = np.sin(2 * np.pi * line_hz / RATE_HZ * np.arange(response.size) + 1.0)
        return reference, response + np.sqrt(2) * 0.01 * response.std() * tone

    return hum


DEFECTS: dict[str, tuple[Spoil, str, str, Cure]] = {
    "clipped at 0.95": (clipped, "clipping", "amplitude_v", Cure.RANGE),
    "a sample of the response lost": (lambda x, y: (x, one_less(y)), "unsteady", "lost samples", Cure.REPEAT),
    "a sample of the reference lost": (lambda x, y: (one_less(x), y), "dropout", "USB port", Cure.REPEAT),
    "a sample doubled": (lambda x, y: (x, one_more(y)), "unsteady", "lost samples", Cure.REPEAT),
    "5 ms without light": (dropped_out, "dropout", "focus the laser", Cure.REPEAT),
    "hum at 50 Hz": (humming(50.0), "hum", "hum at 50 Hz", Cure.NOTHING),
    "hum at 60 Hz, off the grid of bins": (humming(60.1), "hum", "ground loop", Cure.NOTHING),
    "hum at 150 Hz": (humming(150.0), "hum", "3 times 50 Hz", Cure.NOTHING),
    "a sweep fainter by 0.5 dB": (fainter(-0.5), "unsteady", "gain", Cure.REPEAT),
    "a sweep louder by 6 dB": (fainter(6.0), "unsteady", "gain", Cure.REPEAT),
    "a fan": (humming(133.0), "tone", "133.3 Hz", Cure.NOTHING),
}


@pytest.mark.parametrize("record", [STRONG, WEAK], ids=["strong", "weak"])
@pytest.mark.parametrize("name", DEFECTS)
def test_given_a_defect_at_40_db_then_it_is_named_in_the_record_that_has_it(name, record):
    spoil, expected, words, cure = DEFECTS[name]
    judgement = judged(spoil, record)
    assert not judgement.good
    assert [defect.actuators for defect in judgement.defects] == [(record,)]
    if expected == "clipping" and record == WEAK:  # it is loudest at 69 Hz, where no third harmonic can be measured
        return
    assert [defect.name for defect in judgement.defects] == [expected]
    assert words in judgement.reason
    assert judgement.cure == cure


@pytest.mark.parametrize(("averages", "snr_db"), [(1, 25.0), (3, 25.0), (3, 60.0)])
def test_given_clean_records_then_valid_and_nothing_is_named(averages, snr_db):
    judgement = judged(None, STRONG, snr_db=snr_db, averages=averages)
    assert judgement.good, judgement.reason


SECONDS = np.arange(36_000) / RATE_HZ


def all_judged(spoil):
    """All records spoilt alike, at 70 dB signal-to-noise ratio before that."""
    reference, response = quiet_records(3)
    noise = 3e-4 * response.std(axis=1, keepdims=True) * np.random.default_rng(1).normal(size=response.shape)
    spoilt = np.stack([spoil(row) for row in response + noise]).astype(np.float32)
    return judge(estimator(3, 2000).estimate(reference, spoilt, range_v=RANGE_V), False, QualityLimits())


def peak(response):
    return float(np.abs(response).max())


@pytest.mark.parametrize(
    ("spoil", "name", "over_range"),
    [
        (lambda y: np.round(y / peak(y) * 20) * peak(y) / 20, "unexplained", False),
        (lambda y: np.round(y / peak(y) * 12) * peak(y) / 12, "unexplained", False),
        (lambda y: np.clip(y, -0.9 * peak(y), 0.9 * peak(y)), "clipping", True),
        (lambda y: np.clip(y, -peak(y), 0.9 * peak(y)), "clipping", True),
    ],
    ids=["20 steps", "12 steps", "cut", "cut on one side"],
)
def test_given_what_looks_cut_then_only_what_is_cut_is_over_range(spoil, name, over_range):
    judgement = all_judged(spoil)
    assert name in {defect.name for defect in judgement.defects}
    assert bool(judgement.status & Status.OVER_RANGE) == over_range
    assert not judgement.good


def louder(gain_db):
    return lambda response: response * 10 ** (np.interp(np.arange(response.shape[1]), np.arange(36_000), gain_db) / 20)


def later_each_sweep(response):
    """Each sweep 0.3 samples later than the one before, as where a plate gets warmer."""
    turns = np.fft.rfftfreq(12_000)[:, None] * 0.3 * np.arange(3)
    sweeps = np.fft.rfft(response[:, :36_000].reshape(-1, 3, 12_000)) * np.exp(-2j * np.pi * turns.T)
    return np.concatenate([np.fft.irfft(sweeps).reshape(len(response), -1), response[:, 36_000:]], axis=1)


@pytest.mark.parametrize(
    "drifting",
    [
        louder(np.repeat([0.0, 0.1, 0.0], 12_000)),
        louder(-0.5 * SECONDS / 3.6),
        louder(-1.0 * (1 - np.exp(-SECONDS / 0.8))),
        later_each_sweep,
    ],
    ids=["one step of 0.1 dB", "ramp of 0.5 dB", "warming up", "ever later"],
)
def test_given_a_drift_common_to_all_records_then_none_is_taken_for_the_quiet_one(drifting):
    reference, response = quiet_records(3)
    noise = 1e-3 * response.std(axis=1, keepdims=True) * np.random.default_rng(1).normal(size=response.shape)
    spoilt = (drifting(response) + noise).astype(np.float32)
    judgement = judge(estimator(3, 2000).estimate(reference, spoilt, range_v=RANGE_V), False, QualityLimits())
    assert judgement.status == Status.POOR_SIGNAL
    assert "unsteady" in {defect.name for defect in judgement.defects}
    assert sorted(actuator for defect in judgement.defects for actuator in defect.actuators) == [0, 1, 2, 3]


@pytest.mark.parametrize(("spoil", "name"), [(early(dropped_out), "dropout"), (humming(50.0), "hum")])
def test_given_a_single_sweep_then_what_needs_no_comparison_is_still_seen(spoil, name):
    judgement = judged(spoil, STRONG, averages=1)
    assert [(defect.name, defect.actuators) for defect in judgement.defects] == [(name, (STRONG,))]


@pytest.mark.parametrize("record", [STRONG, WEAK], ids=["strong", "weak"])
def test_given_fewer_taps_than_the_response_has_then_its_tail_is_named(record):
    judgement = judged(None, record, taps=250)
    tails = [defect for defect in judgement.defects if defect.name == "tail"]
    assert len(tails) == 1
    assert record in tails[0].actuators
    assert "capture.taps" in judgement.reason


def test_given_one_constant_channel_then_it_is_named_and_is_no_quietest_record():
    reference, response = (channel.copy() for channel in quiet_records(3))
    response += 1e-4 * np.random.default_rng(1).normal(size=response.shape).astype(np.float32)
    response[STRONG] = 0.0123
    estimate = estimator(3, 2000).estimate(reference, response, range_v=RANGE_V)
    judgement = judge(estimate, False, QualityLimits(), DISTANCE_MM)
    assert [(defect.name, defect.actuators) for defect in judgement.defects] == [("dead channel", (STRONG,))]
    assert "cable" in judgement.reason


def test_given_every_channel_dead_then_failed():
    reference, response = quiet_records(3)
    estimate = estimator(3, 2000).estimate(reference, np.full_like(response, 0.25), range_v=RANGE_V)
    judgement = judge(estimate, False, QualityLimits())
    assert judgement.status == Status.FAILED
    assert "constant" in judgement.reason
