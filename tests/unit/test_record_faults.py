"""Faults of records on plates that no constant was chosen on: what harms a row is marked, and nothing clean is.

``python -m pytest -s -m nightly tests/unit/test_record_faults.py`` prints the table of docs/reference/point-quality.md.
"""

import sys
from functools import cache

import numpy as np
import pytest
import scipy.signal

from tests.unit.independent_plates import places, responses
from wavefocus.acquisition.judgement import Judgement, in_band, judge
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.calibration.known_signal import ReferenceMissingError
from wavefocus.config.run import QualityLimits

RATE_HZ, BAND_HZ, TAPS, ACTUATORS = 4000.0, (40.0, 480.0), 800, 8
SWEEP = PlayedExcitation(RATE_HZ, *BAND_HZ, duration_s=0.8, decay_s=0.25, amplitude_v=1.0, averages=3)
RANGE_V = (10.0, 10.0)
HARM_DB = -30.0
DROP = 5200
"""A sample within the second sweep."""


@cache
def _estimator(averages):
    sweep = PlayedExcitation(RATE_HZ, *BAND_HZ, 0.8, 0.25, 1.0, averages)
    return SequentialEstimator(sweep, TAPS)


@cache
def _quiet(kind, place):
    """Reference (samples,), responses (records, samples) of rms 1 at their loudest, and FIRs of one position."""
    grid, actuator_mm = places(kind, 10.0)
    green = responses(kind, grid[[place % len(grid)]], actuator_mm[:ACTUATORS], RATE_HZ, TAPS, BAND_HZ)[0]
    played = np.concatenate([np.zeros(150), SWEEP.signal_v(), np.zeros(60)])
    answered = scipy.signal.fftconvolve(played[None], green, axes=1)[:, : played.size]
    scale = 1 / answered.std(axis=1).max()
    return played, scale * answered, scale * green


def _late(x, samples):
    return np.concatenate([x[:DROP], x[DROP + samples :], x[-samples:]])


def _loud(y):
    return float(np.abs(y).max())


def _step(y, level_db):
    return np.where(np.arange(y.size) < DROP, 1.0, 10 ** (level_db / 20)) * y


def _gap(y, seconds):
    kept = y.copy()
    kept[DROP : DROP + round(seconds * RATE_HZ)] = 0
    return kept


def _tone(y, hertz, level_db):
    wave = np.sin(2 * np.pi * hertz / RATE_HZ * np.arange(y.size) + 1)
    return y + np.sqrt(2) * y.std() * 10 ** (level_db / 20) * wave


def _knock(y, rng):
    hit = y.copy()
    hit[DROP : DROP + 40] += 3 * _loud(y) * np.hanning(40) * rng.standard_normal(40)
    return hit


FAULTS = {
    "cut at 0.7 of the peak": lambda x, y, rng: (x, np.clip(y, -0.7 * _loud(y), 0.7 * _loud(y))),
    "cubic, 15 % at the peak": lambda x, y, rng: (x, y - 0.15 * y**3 / _loud(y) ** 2),
    "hum at 50 Hz, -10 dB": lambda x, y, rng: (x, _tone(y, 50.0, -10.0)),
    "tone at 237 Hz, -10 dB": lambda x, y, rng: (x, _tone(y, 237.0, -10.0)),
    "20 ms without light": lambda x, y, rng: (x, _gap(y, 0.02)),
    "a knock": lambda x, y, rng: (x, _knock(y, rng)),
    "2 samples of the response lost": lambda x, y, rng: (x, _late(y, 2)),
    "7 samples of both lost": lambda x, y, rng: (_late(x, 7), _late(y, 7)),
    "1 dB louder from the second sweep on": lambda x, y, rng: (x, _step(y, 1.0)),
    "gain drifts by 2 dB": lambda x, y, rng: (x, y * 10 ** (np.linspace(0, 2.0, y.size) / 20)),
    "reference 0.5 dB fainter": lambda x, y, rng: (x * 10 ** (-0.5 / 20), y),
    "only noise": lambda x, y, rng: (x, y.std() * rng.standard_normal(y.size)),
}


def _judged(kind, fault, snr_db, record, seed, averages=3):
    """The worst error of a row in band, in dB, and the verdict, of one position with a fault in one record."""
    rng = np.random.default_rng([seed, record, round(snr_db)])
    played, answered, green = _quiet(kind, 7 + 13 * seed)
    used = played.size - 60 * (averages < 3) - (3 - averages) * round(1.05 * RATE_HZ)
    answered = answered[:, :used] + 10 ** (-snr_db / 20) * rng.standard_normal((ACTUATORS, used))
    reference = np.tile(played[:used], (ACTUATORS, 1)) + 1e-4 * rng.standard_normal((ACTUATORS, used))
    if fault is not None:
        rows = range(ACTUATORS) if "both" in fault else [record]
        for row in rows:
            reference[row], answered[row] = FAULTS[fault](reference[row], answered[row], rng)
    try:
        volts = reference.astype(np.float32), answered.astype(np.float32)
        estimate = _estimator(averages).estimate(*volts, range_v=RANGE_V)
    except ReferenceMissingError as missing:
        return 0.0, str(missing)
    found, true = in_band(estimate.green, RATE_HZ, BAND_HZ), in_band(green, RATE_HZ, BAND_HZ)
    wrong = np.linalg.norm(found - true, axis=1) / np.linalg.norm(true, axis=1)
    return 20 * np.log10(wrong[record]), judge(estimate, False, QualityLimits(), before_db=0.0)


def _is_marked(verdict):
    return isinstance(verdict, str) or not verdict.good


@pytest.mark.parametrize("count", [1, pytest.param(ACTUATORS, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("fault", FAULTS)
def test_what_harms_a_row_is_marked(fault, count, capsys):
    cells, kinds = [], ("images", "disk", "elements")
    for snr_db in (40.0, 60.0) if count == ACTUATORS else (40.0,):
        found = [_judged(kinds[n % 3], fault, snr_db, n, seed=n) for n in range(count)]
        there = [verdict for error_db, verdict in found if error_db > HARM_DB]
        seen = sum(map(_is_marked, there))
        names = sorted({defect.name for v in there if isinstance(v, Judgement) for defect in v.defects})
        cells.append(f"{seen} of {len(there)}: {', '.join(names) or 'refused'}")
        assert seen == len(there)
    if count < ACTUATORS:
        return
    with capsys.disabled():
        sys.stdout.write(f"\n| {fault} | {' | '.join(cells)} |")


@pytest.mark.parametrize("kind", ["images", "disk", "elements"])
@pytest.mark.parametrize("averages", [1, 3])
def test_clean_positions_are_valid(kind, averages):
    verdicts = [_judged(kind, None, snr_db, 0, seed, averages)[1] for snr_db in (25.0, 60.0) for seed in range(2)]
    assert [verdict for verdict in verdicts if _is_marked(verdict)] == []
