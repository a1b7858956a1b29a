"""Statistics of answers: against published values, other programs' fits and the paper's own numbers."""

import itertools
import json
import math

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import binom

from wavefocus.config.trials import AdaptiveTable, TrialsTable
from wavefocus.trials.analysis.psychometric_fit import MAX_LAPSES, fit_psychometric
from wavefocus.trials.analysis.report import build_report
from wavefocus.trials.analysis.results import analysis_of, psychometric_of
from wavefocus.trials.analysis.statistics import RIGHT, combinations_of, d_prime, sensitivities_of, shares_of, table_of
from wavefocus.trials.answers import Row
from wavefocus.trials.order import share_right

NASTY = "<script>alert(1)</script>"
ANSWERS = ("left", "right")


def row(trial=1, *, participant="P1", path="left", answer=None, correct=True, speed=40.0, amplitude=1.0, **more):
    given = path if correct else ANSWERS[path == ANSWERS[0]]
    values = {
        "track": "", "stimulus": f"{path}-{speed}", "signal": "burst", "plays": 1, "reaction_s": 0.5,
        "onset_error_ms": 0.1, "onset_within_ms": 0.05, "replays": 0, "attempts": 1, "by": "keyboard",
        "answered_at": "2026-01-01T00:00:00+00:00",
        "stimulus_sha256": "0" * 64, "bank_sha256": "1" * 64, "trials_sha256": "2" * 64,
    }  # fmt: skip
    return Row(
        participant=participant, block=1, trial=trial, path=path, speed_mm_s=speed, amplitude=amplitude,
        answer=given if answer is None else answer, correct=correct, **{**values, **more},
    )  # fmt: skip


DESIGN = TrialsTable(question=NASTY, answers=ANSWERS, correct="path")


@pytest.fixture(scope="module")
def paper():
    """720 answers, as many as in the paper's section V, seven of them wrong as there; of three people."""
    rows, wrong = [], {40.0: 0, 100.0: 1, 250.0: 0, 500.0: 6}
    for number, trial in itertools.product(range(3), range(240)):
        plays, speed = list(enumerate(wrong, 1))[trial % 4]
        bad = wrong[speed] > 0
        wrong[speed] -= bad
        rows.append(
            row(trial + 1, participant=f"P{number}", path=ANSWERS[trial // 4 % 2], correct=not bad,
                speed=speed, plays=plays, signal="impulse" if speed == 500.0 else "burst",
                onset_error_ms=0.01 * trial, reaction_s=0.5 + 0.01 * trial)
        )  # fmt: skip
    return analysis_of(rows, DESIGN), table_of(rows)


def test_given_published_shares_then_wilson_s_intervals_are_theirs():
    # Newcombe, Stat. Med. 17 (1998), 857, table I, method 3.
    published = (81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)
    for count, total, *interval in published:
        rows = [row(number, correct=number < count) for number in range(total)]
        assert shares_of(table_of(rows))[0].interval == pytest.approx(interval, abs=5e-5)
    assert shares_of(table_of(rows[:1]))[0].interval[1] == 1.0


@pytest.mark.long
def test_given_the_paper_s_answers_then_its_accuracies_come_out(paper):
    assert combinations_of(paper[1]) == (("speed_mm_s",), ("path",), ("signal",), ("speed_mm_s", "path"))
    shares = shares_of(paper[1])
    (whole,) = [one for one in shares if not one.participant and not one.factors]
    assert (whole.count, whole.of, whole.outcome) == (713, 720, RIGHT)
    speeds = {one.factors["speed_mm_s"]: round(100 * one.share, 1) for one in shares
              if not one.participant and tuple(one.factors) == ("speed_mm_s",)}  # fmt: skip
    assert speeds == {"40": 100.0, "100": 99.4, "250": 100.0, "500": 96.7}
    assert sum(one.count for one in shares if one.participant and not one.factors) == 713


def test_given_hits_and_false_alarms_then_d_prime_and_criterion_follow_the_text_book():
    # Macmillan and Creelman, Detection Theory (2005), section 1: H = 0.8, F = 0.4: d' = 1.095, c = -0.294. With many
    # trials the correction vanishes.
    value, (low, high), criterion = d_prime(800_000, 1_000_000, 400_000, 1_000_000)
    assert value == pytest.approx(1.095, abs=5e-4)
    assert criterion == pytest.approx(-0.294, abs=5e-4)
    assert low < value < high
    assert high - low < 0.01
    # All right: finite by the log-linear correction, z(10.5 / 11) - z(0.5 / 11).
    assert d_prime(10, 10, 0, 10)[0] == pytest.approx(2 * 1.6906, abs=1e-4)
    # Of many sets of answers the interval holds the truth in most.
    rng = np.random.default_rng(1)
    hits, alarms = rng.binomial(60, 0.8413447, 400), rng.binomial(60, 0.5, 400)
    intervals = [d_prime(int(h), 60, int(f), 60)[1] for h, f in zip(hits, alarms, strict=True)]
    held = sum(low <= 1.0 <= high for low, high in intervals)
    assert held >= binom.ppf(1e-4, 400, 0.95)


def test_given_catch_trials_then_every_amplitude_is_held_against_them():
    rows = [
        row(n, answer="yes" if n < yes else "no", correct=(n < yes) == (amplitude > 0), amplitude=amplitude)
        for amplitude, yes in ((1.0, 12), (0.5, 6), (0.0, 3))
        for n in range(20)
    ]
    ours = [one for one in sensitivities_of(table_of(rows), ("no", "yes")) if not one.participant]
    found = {one.factors.get("amplitude", "all"): one for one in ours}
    assert set(found) == {"all", "0.5", "1"}
    assert (found["1"].signal, found["1"].hits, found["1"].of_signal) == ("yes", 12, 20)
    assert (found["0.5"].false_alarms, found["0.5"].of_noise) == (3, 20)


@pytest.mark.parametrize(
    ("levels", "right", "of"),
    [
        (np.geomspace(0.1, 1.0, 8), [21, 19, 24, 28, 33, 38, 39, 39], 40),
        pytest.param(0.1 * 2 ** np.arange(6), [32, 49, 60, 60, 59, 60], 60, marks=pytest.mark.long),
        pytest.param(0.05 * 2 ** np.arange(7), [51, 54, 70, 92, 99, 99, 99], 100, marks=pytest.mark.long),
    ],
    ids=["usual", "one slip", "three slips"],
)
def test_answers_at_levels_have_the_fit_of_penalised_likelihood(levels, right, of):
    right, of = np.array(right), np.full(len(levels), of)

    def loss(point):
        threshold, log_slope, lapse = point
        x, slope = np.log10(levels), math.exp(log_slope)
        share = np.clip(share_right(x, threshold, slope, 0.5, lapse), 1e-12, 1 - 1e-12)
        middle = share_right(x, threshold, slope, 0.5, MAX_LAPSES / 2)
        logistic = share_right(x, threshold, slope, 0.0, 0.0)
        weights = of * ((0.5 - MAX_LAPSES / 2) * logistic * (1 - logistic)) ** 2 / (middle * (1 - middle))
        columns = np.stack([np.ones(len(x)), x])
        penalty = 0.5 * np.log(max(np.linalg.det(columns * weights @ columns.T), 1e-100))
        return -float(right @ np.log(share) + (of - right) @ np.log1p(-share)) - penalty

    bounds = [(-2, 1), (0, 4.5), (0, MAX_LAPSES)]
    best = minimize(loss, (-0.5, 2.0, 0.02), method="L-BFGS-B", bounds=bounds)
    fit = fit_psychometric(list(levels), list(right), list(of), guess=0.5)
    assert loss((math.log10(fit.threshold), math.log(fit.slope), fit.lapse)) <= best.fun + 1e-6
    assert math.log10(fit.threshold) == pytest.approx(best.x[0], abs=2e-3)
    low, high = fit.threshold_interval
    # The profile at the ends lies at half the 95 % quantile of chi-square, to what its grid resolves.
    for end in (low, high):
        x = math.log10(end)
        there = minimize(lambda rest, x=x: loss((x, *rest)), best.x[1:], method="L-BFGS-B", bounds=bounds[1:])
        assert there.fun - best.fun == pytest.approx(1.92, abs=0.01)
    assert 0.0 < fit.deviance_p <= 1.0


def test_a_share_that_falls_has_the_mirrored_fit_and_a_steep_one_its_interval():
    levels, right, of = [0.1, 0.2, 0.4, 0.8], [11, 13, 18, 20], [20] * 4
    rising = fit_psychometric(levels, right, of, guess=0.5)
    falling = fit_psychometric([1 / one for one in levels], right, of, guess=0.5, falling=True)
    assert falling.slope == pytest.approx(-rising.slope, rel=1e-3)
    assert falling.threshold == pytest.approx(1 / rising.threshold, rel=1e-3)
    assert falling.threshold_interval[0] == pytest.approx(1 / rising.threshold_interval[1], rel=1e-2)
    # A staircase on a steep function: its threshold has hardly any room; the interval is that of a plain evaluation.
    levels, right = np.concatenate([np.linspace(-0.2, 0.2, 9), [0.4, 0.6, 0.8, 1.0]]), [1, 1, 9, 20, 24, 12, 7]
    steep = fit_psychometric(
        10**levels, [*right, 4, 4, 2, 2, 2, 2], [2, 4, 17, 29, 30, 14, 8, 4, 4, 2, 2, 2, 2], guess=0.5
    )
    assert steep.slope_interval == pytest.approx((5.81, 75.9), rel=0.02)


@pytest.mark.parametrize("right", [(0, 0, 20, 20), (20, 20, 20, 20), (10, 10, 10, 10), (20, 15, 10, 5)])
def test_answers_without_a_maximum_likelihood_have_finite_estimates(right):
    fit = fit_psychometric([0.1, 0.2, 0.4, 0.8], list(right), [20] * 4, guess=0.0 if right[0] == 0 else 0.5)
    assert np.isfinite([fit.threshold, fit.slope, fit.deviance]).all()
    for low, high in (fit.threshold_interval, fit.slope_interval):
        assert (low or 0.0) <= (math.inf if high is None else high)


def test_a_staircase_then_its_track_has_a_function_and_the_mean_of_its_reversals():
    up_down = AdaptiveTable(method="up_down", factor="amplitude")
    levels = (1.0, 1.0, *(0.5, 0.5, 0.25) * 3, 0.5, 0.5)
    rows = [row(trial, correct=level > 0.25, amplitude=level, track="t") for trial, level in enumerate(levels, 1)]
    (found,) = psychometric_of(table_of(rows), ANSWERS, up_down)
    assert (found.track, found.factor, found.fit.guess) == ("t", "amplitude", 0.5)
    assert 0.25 <= found.reversals_threshold <= 0.5
    # One level alone has no function.
    assert psychometric_of(table_of([row()]), ANSWERS) == ()


def test_levels_decide_what_is_right_then_no_function_but_of_amplitudes_with_catch():
    levels = [(2.0**power, n > 0) for power in range(6) for n in range(4)]
    rows = [row(speed=level, answer=("slow", "fast")[(level > 5) == good], correct=good) for level, good in levels]
    assert psychometric_of(table_of(rows), ("slow", "fast")) == ()
    rows = [row(amplitude=level, answer=("no", "yes")[good], correct=good) for level, good in levels]
    (found,) = psychometric_of(table_of([*rows, row(amplitude=0.0, answer="no")]), ("no", "yes"))
    assert found.factor == "amplitude"


def test_answers_then_report_shows_them_with_names_escaped_and_holds_all_it_shows(paper):
    analysis = paper[0]
    html, pictures = build_report(analysis, [("answers", "trials.csv")])
    assert NASTY not in html
    assert "713 of 720" in html
    assert f"chance, 1 of {len(analysis.answers)} answers" in html
    assert {one.name for one in pictures} == {"right-speed-mm-s-path", "reaction-times"}
    assert "://" not in html
    json.dumps(analysis.document(), allow_nan=False)


def test_given_no_right_answers_then_shares_of_each_answer_are_tabled():
    rows = [row(n, answer="left" if n % 3 else "right", correct=None) for n in range(30)]
    shares = {one.outcome: one.count for one in shares_of(table_of(rows)) if not one.participant and not one.factors}
    assert shares == {"left": 20, "right": 10}
    html, _ = build_report(analysis_of(rows, DESIGN), [])
    assert "30 answers" in html


def test_given_four_fingers_then_the_confusion_matrix_counts_each_pair():
    fingers, rng = ("thumb", "index", "middle", "ring"), np.random.default_rng(5)
    rights = rng.integers(4, size=120)
    given = [(fingers[right], fingers[right if rng.random() < 0.7 else rng.integers(4)]) for right in rights]
    rows = [
        row(trial + 1, path=f"{right}-place", answer=answer, correct=answer == right, participant=f"P{trial % 2}")
        for trial, (right, answer) in enumerate(given)
    ]
    levels = {f"{name}-place": name for name in fingers}
    design = TrialsTable(question="?", answers=fingers, correct="path", correct_levels=levels)
    analysis = analysis_of(rows, design)
    whole, *own = analysis.confusions
    assert [list(counts) for counts in whole.counts] == [[given.count((a, b)) for b in fingers] for a in fingers]
    assert np.array_equal(np.sum([matrix.counts for matrix in own], axis=0), whole.counts)
    page, _ = build_report(analysis, [])
    assert "Confusion matrix" in page
    assert analysis.document()["confusions"][0]["counts"] == whole.counts
    levels = {"": "still", "40": "slow"}
    design = TrialsTable(question="?", answers=("still", "slow"), correct="speed_mm_s", correct_levels=levels)
    rows = [row(answer="still", speed=None), row(answer="slow")]
    assert analysis_of(rows, design).confusions[0].counts == ((1, 0), (0, 1))
