"""From records to a verdict, on plates that no constant was chosen on: what harms a row is named, nothing clean is.

``python -m pytest -s -m nightly tests/unit/test_record_faults.py`` prints the table of docs/reference/point-quality.md.
"""

import sys
from functools import cache

import numpy as np
import pytest
import scipy.signal

from tests.unit.independent_plates import places, responses
from wavefocus.acquisition.judgement import Cure, in_band, judge
from wavefocus.calibration.estimator.defect_finder import not_looked_at
from wavefocus.calibration.estimator.estimate import Estimate, Records
from wavefocus.calibration.estimator.sequential import BATCH_RECORDS, SequentialEstimator
from wavefocus.calibration.estimator.staggered import StaggeredEstimator
from wavefocus.calibration.excitation import PlayedExcitation, StaggeredSignal
from wavefocus.calibration.known_signal import ReferenceMissingError
from wavefocus.config.run import QualityLimits
from wavefocus.storage.bank.ledger import Status, status_counts

LIMITS = QualityLimits()


def of_figures(**changed):
    figures = {
        "green": np.zeros((4, 8), np.float32),
        "snr_db": np.array([60.0, 40.0, 25.0, 5.0], np.float32),
        "residual_db": np.array([-70.0, -45.0, -27.0, -4.0], np.float32),
        "coherence": np.ones(4, np.float32),
        "peak_v": np.ones(4, np.float32),
        "noise_v": np.full(4, 1e-4, np.float32),
        "clip_count": np.zeros(4, np.int32),
        "offset_samples": np.zeros(4),
        "clock_ratio": np.ones(4),
        "defects": not_looked_at(4),
        "reference_db": np.full(4, np.nan, np.float32),
    }
    return Estimate(**{**figures, **changed})


NOISY_V = np.array([1e-4, 1e-4, 5e-3, 1e-4], np.float32)
LOST = {
    figure: np.where(np.arange(4) == 1, np.nan, getattr(of_figures(), figure))
    for figure in ("snr_db", "residual_db", "noise_v")
}


@pytest.mark.parametrize(
    ("figures", "flag", "status", "words"),
    [
        ({}, True, Status.OVER_RANGE, ""),
        ({"clip_count": np.array([0, 3, 0, 0], np.int32)}, False, Status.OVER_RANGE, ""),
        ({"noise_v": NOISY_V}, True, Status.OVER_RANGE | Status.POOR_SIGNAL, ""),
        *(({figure: values}, False, Status.POOR_SIGNAL, "actuator 1") for figure, values in LOST.items()),
    ],
    ids=["over range by flag", "over range by count", "two faults", *(f"{figure} is no number" for figure in LOST)],
)
def test_figures_that_say_a_fault_or_are_no_numbers_set_its_bit(figures, flag, status, words):
    judgement = judge(of_figures(**figures), flag, LIMITS)
    assert judgement.status == status
    assert words in judgement.reason


def test_status_bytes_are_counted_by_word():
    counts = status_counts(np.array([0, 0, 1, 2, 4, 6, 8, 16], np.uint8))
    assert counts == {"not-measured": 2, "valid": 1, "over-range": 2, "poor": 2, "failed": 1, "disabled": 1}


def test_an_actuator_that_is_silent_though_farther_ones_are_heard_then_it_is_named():
    silent, near = of_figures(snr_db=np.array([1.0, 60.0, 50.0, 40.0], np.float32)), np.array([20.0, 100, 120, 140])
    judgement = judge(silent, False, LIMITS, near)
    assert [(defect.name, defect.actuators) for defect in judgement.defects] == [("silent", (0,))]
    assert judge(silent, False, LIMITS, near[::-1]).good
    assert judge(silent, False, LIMITS, np.full(4, np.nan)).good


RATE_HZ, BAND_HZ, TAPS, ACTUATORS = 4000.0, (40.0, 480.0), 800, 8
RANGE_V = (10.0, 10.0)
HARM_DB = -30.0
LEAD, PERIOD = 150, round(1.05 * RATE_HZ)
DROP = 5200
"""A sample within the second sweep."""
WHITE = np.random.default_rng(8).standard_normal(20_000)


def sweep(averages):
    return PlayedExcitation(RATE_HZ, *BAND_HZ, 0.8, 0.25, 1.0, averages)


@cache
def estimator(averages, taps):
    return SequentialEstimator(sweep(averages), taps)


@cache
def quiet(kind, place):
    """Reference (samples,), responses (records, samples) of rms 1 at their loudest, and FIRs of one position."""
    grid, actuator_mm = places(kind, 10.0)
    green = responses(kind, grid[[place % len(grid)]], actuator_mm[:ACTUATORS], RATE_HZ, TAPS, BAND_HZ)[0]
    played = np.concatenate([np.zeros(LEAD), sweep(3).signal_v(), np.zeros(60)])
    answered = scipy.signal.fftconvolve(played[None], green, axes=1)[:, : played.size]
    scale = 1 / answered.std(axis=1).max()
    return played, scale * answered, scale * green


def loud(y):
    return float(np.abs(y).max())


def late(x, samples):
    return np.concatenate([x[:DROP], x[DROP + samples :], x[-samples:]])


def louder(y, level_db, begin=LEAD + PERIOD, end=LEAD + 2 * PERIOD):
    at = np.arange(y.size)
    return np.where((at >= begin) & (at < end), 10 ** (level_db / 20), 1.0) * y


def dark(y, seconds, begin=DROP):
    return np.where((np.arange(y.size) >= begin) & (np.arange(y.size) < begin + seconds * RATE_HZ), 0.0, y)


def tone(y, hertz, level_db):
    wave = np.sin(2 * np.pi * hertz / RATE_HZ * np.arange(y.size) + 1)
    return y + np.sqrt(2) * y.std() * 10 ** (level_db / 20) * wave


def knocked(y):
    hit = y.copy()
    hit[DROP : DROP + 40] += 3 * loud(y) * np.hanning(40) * np.random.default_rng(3).standard_normal(40)
    return hit


def drifting(y, level_db):
    return y * 10 ** (np.linspace(0, level_db, y.size) / 20)


def spoil(change):
    return lambda x, y: (x, change(y))


ANY, AGAIN, RANGE, MOVE, NONE = Cure.REPEAT, Cure.AGAIN, Cure.RANGE, Cure.MOVE, Cure.NOTHING
FAULTS = {
    "cut at 0.7 of the peak": (spoil(lambda y: y.clip(-0.7 * loud(y), 0.7 * loud(y))), "clipping", "amplitude", RANGE),
    "cut on one side": (spoil(lambda y: np.minimum(y, 0.8 * loud(y))), "clipping", "amplitude_v", RANGE),
    "cubic, 15 % at the peak": (spoil(lambda y: y - 0.15 * y**3 / loud(y) ** 2), "clipping", "third harmonic", RANGE),
    "20 steps": (spoil(lambda y: np.round(y / loud(y) * 20) * loud(y) / 20), "unexplained", "focus the laser", ANY),
    "hum at 50 Hz, -10 dB": (spoil(lambda y: tone(y, 50.0, -10.0)), "hum", "ground loop", NONE),
    "hum at 60.1 Hz, -20 dB": (spoil(lambda y: tone(y, 60.1, -20.0)), "hum", "hum at 60 Hz", NONE),
    "hum at 150 Hz, -20 dB": (spoil(lambda y: tone(y, 150.0, -20.0)), "hum", "3 times 50 Hz", NONE),
    "tone at 237 Hz, -10 dB": (spoil(lambda y: tone(y, 237.0, -10.0)), "tone", "the fan", NONE),
    "5 ms without light": (spoil(lambda y: dark(y, 0.005)), "dropout", "focus the laser", ANY),
    "20 ms without light": (spoil(lambda y: dark(y, 0.02)), "unsteady", "more than noise explains", ANY),
    "a knock": (spoil(knocked), "dropout", "knocked", ANY),
    "a sample of the response lost": (spoil(lambda y: late(y, 1)), "unsteady", "lost samples", ANY),
    "2 samples of the response lost": (spoil(lambda y: late(y, 2)), "unsteady", "lost samples", ANY),
    "a sample doubled": (spoil(lambda y: np.insert(y, DROP, y[DROP])[:-1]), "unsteady", "lost samples", ANY),
    "a sample of the reference lost": (lambda x, y: (late(x, 1), y), "dropout", "USB port", ANY),
    "7 samples of both lost": (lambda x, y: (late(x, 7), late(y, 7)), "refused", "does not carry", ANY),
    "a sweep fainter by 0.5 dB": (spoil(lambda y: louder(y, -0.5)), "unsteady", "gain", ANY),
    "a sweep louder by 6 dB": (spoil(lambda y: louder(y, 6.0)), "unsteady", "gain", ANY),
    "1 dB louder from the second sweep on": (spoil(lambda y: louder(y, 1.0, DROP, 1e9)), "unsteady", "gain", ANY),
    "gain drifts by 2 dB": (spoil(lambda y: drifting(y, 2.0)), "unsteady", "gain", ANY),
    "reference 0.5 dB fainter": (lambda x, y: (x * 10**-0.025, y), "reference level", "loopback cable", AGAIN),
    "only noise": (spoil(lambda y: y.std() * WHITE[: y.size]), "dropout", "no light came back", MOVE),
    "a constant channel": (spoil(lambda y: np.full_like(y, 0.0123)), "dead channel", "cable", ANY),
}  # fmt: skip
"""What is done to reference and response of a record; the name that it gets, words of the reason, the cure."""


def judged(kind, put, snr_db, records, seed, averages=3, taps=TAPS):
    """The worst error of a row in band, in dB, the verdict and the estimate of a position with a fault in records."""
    rng = np.random.default_rng([seed, records[0], round(snr_db)])
    played, answered, green = quiet(kind, 7 + 13 * seed)
    used = played.size - 60 * (averages < 3) - (3 - averages) * PERIOD
    answered = answered[:, :used] + 10 ** (-snr_db / 20) * rng.standard_normal((ACTUATORS, used))
    reference = np.tile(played[:used], (ACTUATORS, 1)) + 1e-4 * rng.standard_normal((ACTUATORS, used))
    for row in records if put is not None else ():
        reference[row], answered[row] = put(reference[row], answered[row])
    volts = reference.astype(np.float32), answered.astype(np.float32)
    estimate = estimator(averages, taps).estimate(*volts, range_v=RANGE_V)
    found, true = in_band(estimate.green, RATE_HZ, BAND_HZ), in_band(green[:, :taps], RATE_HZ, BAND_HZ)
    wrong = np.linalg.norm(found - true, axis=1) / np.linalg.norm(true, axis=1)
    return 20 * np.log10(wrong[list(records)].max()), judge(estimate, False, LIMITS, before_db=0.0), estimate


def names_of(judgement):
    return {defect.name for defect in judgement.defects}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_in_one_record_is_named_there_with_its_cure(name):
    put, given, words, cure = FAULTS[name]
    kind, record = (("images", 0), ("disk", 3))[list(FAULTS).index(name) % 2]
    if given == "refused":
        with pytest.raises(ReferenceMissingError, match=words):
            judged(kind, put, 40.0, range(ACTUATORS), seed=record)
        return
    _, judgement, _ = judged(kind, put, 40.0, [record], seed=record)
    assert not judgement.good
    assert {defect.actuators for defect in judgement.defects} == {(record,)}
    assert names_of(judgement) - {"over-range"} == {given}
    assert words in judgement.reason
    assert judgement.cure == cure
    assert bool(judgement.status & Status.OVER_RANGE) or cure != Cure.RANGE


@pytest.mark.nightly
@pytest.mark.parametrize("name", FAULTS)
def test_what_harms_a_row_is_marked(name, capsys):
    cells, both = [], "both" in name
    for snr_db in (40.0, 60.0):
        harmful, marked, names = 0, 0, set()
        for number in range(ACTUATORS):
            records = range(ACTUATORS) if both else [number]
            try:
                kind = ("images", "disk", "elements")[number % 3]
                error_db, judgement, _ = judged(kind, FAULTS[name][0], snr_db, records, seed=number)
            except ReferenceMissingError:
                error_db, judgement = 0.0, None
            if error_db > HARM_DB:
                harmful, marked = harmful + 1, marked + (judgement is None or not judgement.good)
                names |= {"refused"} if judgement is None else names_of(judgement)
        cells.append(f"{marked} of {harmful}: {', '.join(sorted(names))}")
        assert marked == harmful
    with capsys.disabled():
        sys.stdout.write(f"\n| {name} | {' | '.join(cells)} |")


@pytest.mark.parametrize("kind", ["images", "disk", "elements"])
@pytest.mark.parametrize("averages", [1, 3])
def test_clean_positions_are_valid(kind, averages):
    for snr_db in (25.0, 60.0):
        _, judgement, _ = judged(kind, None, snr_db, [0], 1, averages)
        assert judgement.good, judgement.reason


def test_hum_below_the_band_that_leaves_the_rows_right_then_they_are_valid():
    error_db, judgement, estimate = judged("images", spoil(lambda y: tone(y, 23.0, -40.0)), 80.0, range(8), 0)
    assert error_db < -50
    assert judgement.status == Status.VALID
    assert float(estimate.residual_db.max()) == pytest.approx(error_db, abs=10)


def test_faint_records_of_few_steps_are_excused_wherever_the_loudest_one_is():
    played, answered, _ = quiet("images", 7)
    few_steps = np.round(answered[:1] / loud(answered[0]) * 20) * loud(answered[0]) / 20
    response = np.concatenate([30 * answered[:1], np.repeat(few_steps, BATCH_RECORDS, axis=0)])
    reference = np.tile(played, (len(response), 1))
    volts = reference.astype(np.float32), response.astype(np.float32)
    estimate = estimator(3, TAPS).estimate(*volts, range_v=(10.0, 200.0))
    assert np.isneginf(estimate.defects["misfit_db"][1:]).all()


def later_each_sweep(y):
    """Each sweep 0.3 samples later than the one before, as where a plate gets warmer."""
    turns = np.exp(-2j * np.pi * np.fft.rfftfreq(PERIOD) * 0.3 * np.arange(3)[:, None])
    parts = np.fft.rfft(y[LEAD : LEAD + 3 * PERIOD].reshape(3, -1)) * turns
    return np.concatenate([y[:LEAD], np.fft.irfft(parts, PERIOD).ravel(), y[LEAD + 3 * PERIOD :]])


EVERY, WARM_S = range(ACTUATORS), 0.8
SPREAD = {
    "all records louder by 0.1 dB": (lambda y: louder(y, 0.1), EVERY, {}, "unsteady", "the sweeps of", ANY),
    "all records drift by 0.5 dB": (lambda y: drifting(y, -0.5), EVERY, {}, "unsteady", "the sweeps of", ANY),
    "all records warm up": (
        lambda y: y * 10 ** ((np.exp(-np.arange(y.size) / RATE_HZ / WARM_S) - 1) / 20), EVERY, {}, "unsteady",
        "the sweeps of", ANY,
    ),
    "each sweep later in all records": (later_each_sweep, EVERY, {}, "unsteady", "the sweeps of", ANY),
    "a single sweep, 5 ms without light": (
        lambda y: dark(y, 0.005, DROP - PERIOD), [0], {"averages": 1}, "dropout", "a burst", ANY,
    ),
    "a single sweep, hum": (lambda y: tone(y, 50.0, -10.0), [0], {"averages": 1}, "hum", "hum at 50 Hz", NONE),
    "hum 40 dB below the response": (lambda y: tone(y, 50.0, -40.0), [0, 3], {}, "hum", "hum at 50 Hz", NONE),
    "hum at 60.1 Hz, -40 dB": (lambda y: tone(y, 60.1, -40.0), [0, 3], {}, "hum", "ground loop", NONE),
    "hum at 150 Hz, -40 dB": (lambda y: tone(y, 150.0, -40.0), [0, 3], {}, "hum", "3 times 50 Hz", NONE),
    "fewer taps than the response has": (lambda y: y, EVERY, {"taps": 160}, "tail", "capture.taps", NONE),
    "every channel dead": (lambda y: np.full_like(y, 0.25), EVERY, {}, "dead channel", "constant", ANY),
}  # fmt: skip
"""What is done to some records of a position, how it is measured; the name that they all get, words, the cure."""


@pytest.mark.parametrize("name", SPREAD)
def test_a_fault_of_several_records_or_of_a_single_sweep_is_named_in_each_of_them(name):
    change, records, measured, given, words, cure = SPREAD[name]
    snr_db = 40.0 if measured.get("averages") else 60.0
    _, judgement, _ = judged("images", spoil(change), snr_db, records, 0, **measured)
    assert judgement.status == (Status.FAILED if given == "dead channel" else Status.POOR_SIGNAL)
    assert names_of(judgement) - {"low signal"} == {given}
    assert {row for defect in judgement.defects for row in defect.actuators} == set(records)
    assert words in judgement.reason
    assert judgement.cure == cure


def test_hum_in_staggered_records_that_makes_the_rows_wrong_is_named():
    signal = StaggeredSignal(sweep(2), ACTUATORS, TAPS, round(1.05 * TAPS))
    (base, sounding), *_ = signal.played_v(4 * TAPS)
    _, _, green = quiet("images", 7)
    answered = sum(np.convolve(sounding[k], row)[: base.size] for k, row in enumerate(green))[4 * TAPS :]
    reference = base[4 * TAPS :] + 1e-5 * np.random.default_rng(2).standard_normal(answered.size)
    records = Records(RATE_HZ, BAND_HZ, TAPS, signal.schedule())
    volts = (row[None].astype(np.float32) for row in (reference, tone(answered, 120.0, -5.0)))
    estimate = StaggeredEstimator(signal.base_v(), records).estimate(*volts, range_v=RANGE_V)
    found, true = (in_band(rows, RATE_HZ, BAND_HZ) for rows in (estimate.green, green))
    assert np.linalg.norm(found - true) > 10 ** (-35 / 20) * np.linalg.norm(true)
    judgement = judge(estimate, False, LIMITS)
    assert judgement.status & Status.POOR_SIGNAL
    assert names_of(judgement) & {"tone", "hum"}
