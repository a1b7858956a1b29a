"""From what a trial measured to a schedule and a sentence."""

from __future__ import annotations

import math

import numpy as np
import pytest

from wavefocus.acquisition.trial import Candidate, choose, repeated_error, sequential_errors
from wavefocus.calibration.estimator.schedule_error import measure_decay
from wavefocus.storage.errors import InputError

HOUR_S = 3600.0


def tried(staggered_db: float, half_db: float, groups_db: float, sequential_db: float = -60.0) -> list[Candidate]:
    return [
        Candidate("staggered capture", 1, 0.0, 2 * HOUR_S, staggered_db),
        Candidate("staggered capture at -6 dB", 1, -6.0, 2 * HOUR_S, half_db),
        Candidate("staggered capture in 4 groups of 5", 4, 0.0, 2.6 * HOUR_S, groups_db),
        Candidate("sequential capture", 0, 0.0, 31 * HOUR_S, sequential_db),
    ]


@pytest.mark.parametrize(
    ("candidates", "chosen", "words"),
    [
        (tried(-62, -56, -58), "staggered capture", "staggered capture pays: it leaves -62.0 dB in 2 h 00 min"),
        (tried(-40, -58, -50), "staggered capture at -6 dB", "the plate distorts"),
        (tried(-40, -50, -58), "staggered capture in 4 groups of 5", "the plate distorts"),
        (tried(-47, -47, -47), "sequential capture", "its noise grows with the signal"),
        (tried(-50, -44, -46), "sequential capture", "noise is too loud for it"),
        (tried(math.inf, -58, -58), "staggered capture at -6 dB", "it leaves the range of an input"),
    ],
)
def test_the_quickest_schedule_that_errs_little_more_is_taken_and_the_sentence_says_why(
    candidates: list[Candidate], chosen: str, words: str
) -> None:
    verdict = choose(candidates, 3.0)
    assert verdict.chosen.name == chosen
    assert words in verdict.reason


def noise(seed: int, share: float) -> np.ndarray:
    draw = np.random.default_rng(seed)
    return np.sqrt(share / 2) * (draw.standard_normal((8, 400)) + 1j * draw.standard_normal((8, 400)))


TRUE = np.exp(1j * np.random.default_rng(0).uniform(0, 6, (8, 400)))


def test_given_noise_alone_then_its_share_is_the_error() -> None:
    takes = [TRUE + noise(seed, 1e-5) for seed in (1, 2, 3)]
    found = repeated_error(takes, TRUE + noise(4, 1e-4), np.full(8, 1e-4))
    assert found == pytest.approx(-50, abs=0.5)


def test_given_a_take_that_speckle_spoilt_then_the_others_count() -> None:
    takes = [TRUE + noise(1, 1e-5), TRUE + noise(2, 0.1), TRUE + noise(3, 1e-5)]
    assert repeated_error(takes, TRUE, np.full(8, 1e-9)) == pytest.approx(-50, abs=0.5)


def test_given_what_all_takes_have_wrong_then_it_is_part_of_the_error() -> None:
    wrong = noise(9, 1e-3)
    takes = [TRUE + wrong + noise(seed, 1e-5) for seed in (1, 2, 3)]
    assert repeated_error(takes, TRUE, np.full(8, 1e-9)) == pytest.approx(-30, abs=0.5)


def test_given_a_cubic_plate_then_sequential_capture_at_two_levels_tells_its_bias() -> None:
    bias = noise(5, 1e-4)
    (full_db, half_db), reference, _ = sequential_errors(
        TRUE + bias, TRUE + bias / 4, np.full(8, 1e-7), np.full(8, 4e-7)
    )
    assert full_db == pytest.approx(-40, abs=0.5)
    assert half_db == pytest.approx(-52, abs=0.5)
    assert np.abs(reference - TRUE).max() < 1e-6


def test_a_decay_gives_taps_and_stagger_and_refuses_fewer_taps() -> None:
    # 60 dB in 0.1 s, over noise.
    time_s = np.arange(3000) / 1e4
    draw = np.random.default_rng(1)
    green = draw.standard_normal((20, 3000)) * 10 ** (-30 * time_s)
    green = green + 1e-5 * draw.standard_normal(green.shape)
    decay = measure_decay(green, 1e4)
    assert decay.rate_db_s == pytest.approx(600, rel=0.05)
    assert decay.needed_taps == pytest.approx(1000, rel=0.1)
    assert decay.needed_stagger_s == pytest.approx(1.2 * decay.response_s)
    decay.require(2000)
    with pytest.raises(InputError, match="taps is 500; the measured responses need at least"):
        decay.require(500)


def test_a_decay_that_noise_hides_is_not_guessed() -> None:
    with pytest.raises(InputError, match="before noise or their last tap hides them"):
        measure_decay(np.random.default_rng(2).standard_normal((20, 2000)), 1e4)
    with pytest.raises(InputError, match="zeros or not finite"):
        measure_decay(np.zeros((20, 2000)), 1e4)
    with pytest.raises(InputError, match="have 50 taps"):
        measure_decay(np.ones((20, 50)), 1e4)
