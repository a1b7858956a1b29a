"""Adaptive levels: staircases and QUEST+, and their order with several tracks."""

import itertools
import math
import random

import numpy as np
import pytest

from tests.simulated_people import STROKES, WHICH_WAY, design_of
from wavefocus.config.trials import AdaptiveTable
from wavefocus.trials.order import QuestPlus, Trial, UpDown, order_of, share_right, track_of

LADDER = tuple(np.geomspace(0.01, 1.0, 17).tolist())


def table(**keys):
    return AdaptiveTable.model_validate({"method": "up_down", "factor": "amplitude", **keys})


def levels_of(track, answers):
    levels = []
    for answer in answers:
        levels.append(track.next_level())
        track.answered(answer == "+")
    return [*levels, track.next_level()]


def test_staircase_from_the_easiest_goes_down_after_two_right_and_up_after_a_wrong():
    track = UpDown(table(reversals=4), [4.0, 3.0, 2.0, 1.0])
    assert levels_of(track, "++++-++-++") == [4, 4, 3, 3, 2, 3, 3, 2, 3, 3, None]
    assert track.reversals == [2, 3, 2, 3]
    assert track.threshold == pytest.approx((math.log10(2) + math.log10(3)) / 2)
    assert track_of(table(), [1.0, 3.0, 2.0]).next_level() == 3.0
    assert track_of(table(factor="speed_mm_s", harder="higher"), [1.0, 3.0, 2.0]).next_level() == 1.0


@pytest.mark.parametrize(("harder", "sign"), [("lower", 1), ("higher", -1)])
def test_quest_plus_finds_threshold_and_slope_of_an_observer(harder, sign):
    rng = np.random.default_rng(5)
    thresholds, slopes = [], []
    for _ in range(8):
        track = QuestPlus(table(method="quest_plus", trials=100, harder=harder), LADDER[::-sign])
        while (level := track.next_level()) is not None:
            track.answered(bool(rng.random() < share_right(math.log10(level), -0.9, 8.0 * sign, 0.5, 0.02)))
        thresholds.append(track.threshold)
        slopes.append(math.log(sign * track.slope))
    assert np.mean(thresholds) == pytest.approx(-0.9, abs=0.05)
    assert np.std(thresholds) < 0.15
    assert np.mean(slopes) == pytest.approx(math.log(8.0), abs=0.35)


TAP = '\ntap = { kind = "impulse" }'
DESIGN = f"""{WHICH_WAY}familiarise = false

[adaptive]
method = "up_down"
factor = "amplitude"
trials = 40
{STROKES.replace('"burst"', '["burst", "tap"]').replace("[signal]", "[signal]" + TAP)}amplitude = [0.5, 1, 2, 4]
"""


def test_tracks_take_random_turns_and_resume_from_the_answers_alone(tmp_path):
    design = design_of(tmp_path, DESIGN)
    assert (design.tracks, design.trials) == (("200mm_s-burst", "200mm_s-tap"), None)
    order, chance = order_of(design, "P1"), random.Random(1)
    trials: list[Trial] = []
    answers: list[str] = []
    while (trial := order.next_trial()) is not None:
        trials.append(trial)
        answers.append(chance.choice(("left", "right")))
        order.answered(answers[-1])
    resumed = order_of(design, "P1")
    for trial, answer in zip(trials, answers, strict=True):
        assert resumed.next_trial() == trial
        assert design.stimuli[trial.stimulus].track == trial.track
        resumed.answered(answer)
    assert resumed.next_trial() is None
    paths = [design.stimuli[trial.stimulus].path for trial in trials]
    assert set(paths) == {"left", "right"}
    assert all(len(set(paths[k : k + 3])) > 1 for k in range(len(paths) - 2))
    turns = [trial.track for trial in trials]
    assert 0.2 < np.mean([a != b for a, b in itertools.pairwise(turns)]) < 0.9
    for name in design.tracks:
        track = track_of(table(trials=40), [0.5, 1.0, 2.0, 4.0])
        for trial, answer in zip(trials, answers, strict=True):
            stimulus = design.stimuli[trial.stimulus]
            if trial.track == name:
                assert track.next_level() == stimulus.amplitude
                track.answered(answer == stimulus.correct)
        assert track.next_level() is None
