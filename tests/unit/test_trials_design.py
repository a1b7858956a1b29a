"""Trials files: stimuli, right answers, and the order of each participant's trials."""

import hashlib
import itertools
from collections import Counter

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.simulated_people import design_of
from wavefocus import InputError, Line, Noise, Point, Source
from wavefocus.trials.order import Draws, FixedOrder, order_of, ordered

TRIALS = """
[trials]
question = "Which way?"
answers = ["left", "right"]
correct = "path"
repetitions = 6
blocks = 2

[path]
right = { kind = "line", start_mm = [-60, 0], end_mm = [60, 0] }
left = { kind = "line", start_mm = [60, 0], end_mm = [-60, 0] }
here = { kind = "point", at_mm = [0, 0] }

[signal]
burst = { kind = "noise", band_hz = [150, 300], duration_s = 0.05, seed = 1 }
tap = { kind = "impulse" }
"""
STIMULI = """
[[stimuli]]
path = ["left", "right"]
signal = "burst"
speed_mm_s = [40, 100]
step_mm = 24
emission = "per_point"
plays = 2
"""
POINT = '\n[[stimuli]]\npath = "here"\nsignal = ["tap", "burst"]\namplitude = [0, 0.5]\n'
ADAPTIVE = '\n[adaptive]\nmethod = "up_down"\nfactor = "amplitude"\n'
ONE = '\n[[stimuli]]\npath = ["left", "right"]\nsignal = "tap"\nspeed_mm_s = 40\nstep_mm = 24\n'


def test_stimuli_are_all_combinations_of_the_levels_of_each_table(tmp_path):
    design = design_of(tmp_path, TRIALS + STIMULI)
    assert list(design.stimuli) == [
        "left-40mm_s-burst", "left-100mm_s-burst", "right-40mm_s-burst", "right-100mm_s-burst",
    ]  # fmt: skip
    one = design.stimuli["right-100mm_s-burst"]
    assert (one.path, one.speed_mm_s, one.signal, one.amplitude, one.plays) == ("right", 100.0, "burst", 1.0, 2)
    assert (one.correct, one.track) == ("right", "")
    assert one.scene.sources == (
        Source(Line((-60, 0), (60, 0)), Noise((150, 300), 0.05, 1), 0.0, 100.0, 24.0, 1.0, "per_point"),
    )
    assert design.trials == 24
    assert design.sha256 == hashlib.sha256((tmp_path / "trials.toml").read_bytes()).hexdigest()
    assert dict(design.keys) == {"left": "1", "right": "2"}


def test_several_amplitudes_then_names_have_them_and_zero_is_an_answer_of_its_own(tmp_path):
    text = TRIALS.replace('"left", "right"', '"no", "yes"').replace('"path"', '"amplitude"')
    text = text.replace("repetitions", 'correct_levels = { 0 = "no", "0.5" = "yes" }\nrepetitions')
    design = design_of(tmp_path, text + POINT)
    assert {name: one.correct for name, one in design.stimuli.items()} == {
        "here-tap-amp0": "no", "here-tap-amp0.5": "yes", "here-burst-amp0": "no", "here-burst-amp0.5": "yes",
    }  # fmt: skip
    assert design.stimuli["here-tap-amp0"].speed_mm_s is None
    assert design.stimuli["here-tap-amp0"].scene.sources[0].path == Point((0, 0))


def test_given_a_trajectory_then_it_needs_no_speed_and_its_signal_may_repeat(tmp_path):
    (tmp_path / "finger.csv").write_text("time_s,x_mm,y_mm\n0,0,0\n0.2,10,0\n")
    table = '\n[[stimuli]]\npath = "left"\nsignal = "burst"\nrepeat = true\n'
    moves = 'left = { kind = "trajectory", file = "finger.csv" }\nhere ='
    text = TRIALS.replace("left = {", "away = {").replace("here =", moves)
    text = text.replace("repetitions", "most_alike = 0\nrepetitions")
    (one,) = design_of(tmp_path, text + table).stimuli.values()
    (source,) = one.scene.sources
    assert (one.name, one.speed_mm_s, source.travel_s, source.repeat) == ("left-burst", None, 0.2, True)


MISTAKES = [
    ('answers = ["left", "right"]', 'answers = ["left", "left"]', "trials.answers"),
    ('"left", "right"]', r'"left", "to the\nright"]', "trials.answers[1]"),
    ("repetitions", 'keys = ["F", "f"]\nrepetitions', "trials.keys"),
    ("repetitions", 'keys = ["Esc", "F"]\nrepetitions', "trials.keys[0]"),
    ("blocks = 2", "blocks = 4", "trials.repetitions"),
    ("repetitions = 6", "repetitions = 5000", "trials.repetitions"),
    ("repetitions", 'correct_levels = { up = "left" }\nrepetitions', "trials.correct_levels"),
    ('"left", "right"]\ncorrect', '"left", "up"]\ncorrect', "trials.correct"),
    ('correct = "path"', 'correct = "wind"', "trials.correct"),
    ("repetitions", 'alike = "signal"\nrepetitions', "trials.most_alike"),
    ('path = ["left", "right"]', 'path = ["left", "away"]', "stimuli[0].path"),
    ('path = ["left", "right"]', 'path = ["left", "here"]', "stimuli[0].speed_mm_s"),
    ('path = ["left", "right"]', 'path = ["left", "left"]', "stimuli[0]"),
    ("speed_mm_s = [40, 100]", "speed_mm_s = []", "stimuli[0].speed_mm_s"),
    ("step_mm = 24", "", "stimuli[0].step_mm"),
    ("plays = 2", "plays = 0", "stimuli[0].plays"),
    ("plays = 2", "play = 2", "stimuli[0].play"),
    ("here =", '"../here" =', "path.../here"),
    ('tap = { kind = "impulse" }', 'tap = { kind = "file", path = "none.wav" }', "signal.tap.path"),
    ("plays = 2", f"plays = 2\n{ADAPTIVE}", "trials.repetitions"),
    ("plays = 2", "plays = 2\n[masking]\noutput = 21\nrms_v = 0", "masking.rms_v"),
]
NO_LADDERS = [
    (ONE, "", "adaptive.factor"),
    (ONE + "amplitude = [0, 1]", "", "adaptive.factor"),
    (ONE + "amplitude = [1, 2]" + ONE.replace('"left", ', "") + "amplitude = 3", "", "adaptive.factor"),
    (ONE.replace('"left", ', "") + "amplitude = [1, 2]", "", "trials.most_alike"),
    (ONE + "amplitude = [1, 2]", "trials = 9999", "adaptive.trials"),
    (ONE + "amplitude = [1, 2]", "guess_rate = 0.98", "adaptive.guess_rate"),
]


def test_a_mistake_or_no_ladder_is_one_sentence_with_file_and_key(tmp_path):
    texts = []
    for before, after, key in MISTAKES:
        assert before in TRIALS + STIMULI
        texts.append(((TRIALS + STIMULI).replace(before, after, 1), key))
    adaptive = TRIALS.replace("repetitions = 6\nblocks = 2\n", "")
    for stimuli, more, key in NO_LADDERS:
        texts.append((adaptive + stimuli + stimuli.replace('"tap"', '"burst"') + ADAPTIVE + more, key))
    for text, key in texts:
        with pytest.raises(InputError) as raised:
            design_of(tmp_path, text)
        assert str(raised.value).startswith(f"{tmp_path / 'trials.toml'}: {key}")
        assert "\n" not in str(raised.value)


@settings(max_examples=50)
@given(
    counts=st.lists(st.integers(1, 7), min_size=1, max_size=5),
    each=st.integers(1, 4),
    blocks=st.integers(1, 4),
    most_alike=st.integers(0, 4),
    seed=st.integers(0, 10**6),
)
def test_order_is_balanced_in_each_block_and_never_too_many_are_alike(counts, each, blocks, most_alike, seed):
    level_of = {f"{level}-{k}": str(level) for level, count in enumerate(counts) for k in range(count)}
    others = sum(counts) - max(counts)
    # Exactly what a design may be: see `wavefocus.trials.design`.
    assume(not most_alike or each * max(counts) <= most_alike * (each * others + (blocks == 1)))
    names = ordered(
        list(level_of), level_of.__getitem__, Draws(str(seed)), each=each, blocks=blocks, most_alike=most_alike
    )
    size = each * len(level_of)
    for block in range(blocks):
        assert Counter(names[block * size : (block + 1) * size]) == dict.fromkeys(level_of, each)
    assert len(names) == blocks * size
    if most_alike:
        assert max(len(list(same)) for _, same in itertools.groupby(map(level_of.get, names))) <= most_alike


def test_each_participant_has_order_of_their_own_that_no_version_of_python_changes(tmp_path):
    design = design_of(tmp_path, TRIALS + STIMULI)
    first, again, other = (order_of(design, code) for code in ("P01", "P01", "P02"))
    assert all(isinstance(one, FixedOrder) for one in (first, again, other))
    assert first.trials == again.trials != other.trials
    assert [(one.number, one.block) for one in first.trials] == [(1 + k, 1 + k // 12) for k in range(24)]
    assert " ".join(one.stimulus.removesuffix("mm_s-burst") for one in first.trials[:6]) == (
        "right-100 right-40 left-100 right-100 left-100 right-100"
    )
