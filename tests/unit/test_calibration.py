"""Calibrations with a person at the bench: cables forgotten, marks that stick out, actuators against each other."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.lab_files import rig_fault, setup_of
from wavefocus.acquisition.calibrate_channels import (
    NotMeasuredError,
    Probe,
    compare_actuators,
    listening_places,
    measure_actuators,
    measure_inputs,
    measure_outputs,
)
from wavefocus.acquisition.calibrate_mirror import Operator, read_fiducials, suspect_mark
from wavefocus.calibration.mirror_map import MirrorMap, fit_mirror_map
from wavefocus.config.messages.rig_checks import Answer
from wavefocus.config.outline import Outline, default_marks_mm
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.storage.errors import InputError

RATE_HZ = 10_000.0
ACTUATORS = ((110.0, 0.0), (40.0, 66.0), (-40.0, 66.0))


class Hands(Operator):
    """A person who forgets some cables, and tries so often before giving up."""

    def __init__(self, rig, *, forgets=(), patience=5):
        self._bay, self._forgets, self._patience = rig.patch_bay, list(forgets), patience
        self.plugged, self.problems = [], []

    def report(self, line):
        pass

    def plug_in(self, source):
        self.plugged.append(source)
        if source in self._forgets:
            self._forgets.remove(source)
            return
        self._bay.connect(source)

    def jog(self, view):
        return Answer("here")

    def judge(self, view):
        return Answer("keep")

    def again(self, problem):
        self.problems.append(problem)
        self._patience -= 1
        return self._patience > 0


def bench(**changes):
    rig = VirtualRig(replace(VirtualSettings(actuator_mm=ACTUATORS, dropout_probability=0.0), **changes))
    setup = setup_of(rig, inter_channel_delay_s=5e-6)
    return rig, setup, Probe(setup, RATE_HZ, 1.0)


def outputs(probe, hands, box_gain=None):
    return measure_outputs(probe, (5.0,) * 4, hands, lambda done, total: None, box_gain)


@pytest.mark.parametrize("left", ["both", "output 2"])
def test_given_another_cable_than_asked_for_then_the_person_is_asked_again(left):
    rig, _, probe = bench()
    rig.patch_bay.connect(left)
    hands = Hands(rig, forgets=("output 0",))
    found = outputs(probe, hands)
    assert hands.plugged == ["output 0", "output 0", "output 1", "output 2"]
    assert len(hands.problems) == 1
    assert [one.channel for one in found] == [3, 0, 1, 2]


def test_the_loopback_in_place_of_the_summing_box_then_nothing_is_measured_by_it():
    rig, _, probe = bench()
    rig.patch_bay.connect("both")
    with pytest.raises(NotMeasuredError):
        outputs(probe, Hands(rig, forgets=("sum",), patience=1), 0.0)
    hands = Hands(rig, forgets=("sum",))
    assert len(outputs(probe, hands, 0.0)) == 4
    assert hands.plugged == ["sum", "sum"]


def test_an_input_that_hears_the_same_cable_more_softly_then_the_inputs_are_refused():
    rig, _, probe = bench(fault_plan=(rig_fault("recorder", "read", "drift", at_call=1, count=3, level_db=-3.0),))
    with pytest.raises(NotMeasuredError, match=r"the same cable -29\.\d % apart: check cables and terminal"):
        measure_inputs(probe, Hands(rig))


@pytest.mark.parametrize("measure", [measure_inputs, outputs])
def test_given_no_loopback_then_nothing_is_measured_and_it_says_why(measure):
    rig, _, probe = bench(output_gain=(1.0, 1.0, 1.0, 0.0))
    with pytest.raises(NotMeasuredError, match="no signal from the loopback at the reference input"):
        measure(probe, Hands(rig, patience=1))


def test_given_an_output_given_up_then_the_others_are_measured():
    rig, _, probe = bench(output_gain=(1.0, 0.0, -0.9, 1.1))
    hands = Hands(rig, patience=2)
    found = {one.channel: one for one in outputs(probe, hands)}
    assert sorted(found) == [0, 2, 3]
    assert hands.plugged == ["output 0", "output 1", "output 1", "output 2"]
    assert all("no signal from output 1" in problem for problem in hands.problems)
    assert (found[2].polarity, found[0].polarity, found[3].polarity) == (-1, 1, 1)
    assert found[2].full_scale_v == pytest.approx(4.5, rel=1e-3)
    assert found[3].full_scale_v == pytest.approx(5.5, rel=1e-3)


def test_given_a_passing_fault_then_the_record_is_taken_again():
    faults = (
        rig_fault("player", "wait", "underflow", at_call=2),
        rig_fault("recorder", "read", "short_read", at_call=4),
    )
    rig, _, probe = bench(fault_plan=faults)
    assert measure_inputs(probe, Hands(rig)).late_s == pytest.approx(5e-6, abs=1e-7)


def test_an_actuator_is_heard_again_after_speckle_and_named_where_it_is_too_loud():
    fault = rig_fault("recorder", "read", "dropout", position=1, attempt=1)
    _, setup, _ = bench(fault_plan=(fault,))
    places = listening_places(np.array(ACTUATORS), 30.0)
    found = measure_actuators(places, 1.0, RATE_HZ, setup)
    assert found.verdict == ("good",) * 3
    assert np.abs(found.level_db).max() < 2 * 2.0
    with pytest.raises(NotMeasuredError, match="actuator 0 at 1 V reaches the end of an input's range"):
        measure_actuators(places, 1.0, RATE_HZ, replace(setup, range_v=(10.0, 0.02)))


@pytest.mark.parametrize(("length_mm", "width_mm"), [(250.0, 150.0), (150.0, 150.0), (1000.0, 50.0)])
def test_given_any_surface_then_the_marks_offered_lie_on_it_and_decide_a_map(length_mm, width_mm):
    marks = default_marks_mm(length_mm, width_mm)
    assert Outline.stadium(length_mm, width_mm).contains(marks).all()
    angles = np.column_stack(MirrorMap.straight(1000.0).angles_mrad(*np.array(marks).T))
    assert fit_mirror_map(marks, angles.tolist()).rms_mm < 1e-6


@pytest.mark.parametrize("off", [0, 3, 6])
def test_given_one_mark_that_is_off_then_it_is_the_one_suspected(off):
    marks = default_marks_mm(250.0, 150.0)
    rng = np.random.default_rng(off)
    there = np.array(marks) + rng.normal(0, 0.1, (7, 2))
    there[off] += (9.0, 6.0)
    angles = np.column_stack(MirrorMap.straight(1000.0).angles_mrad(*there.T))
    found = fit_mirror_map(marks, angles.tolist())
    assert suspect_mark(found) == off
    assert found.worst_mm > 1.0


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "line 1: must be the header x_mm,y_mm or x_mm,y_mm,x_mrad,y_mrad"),
        ("x_mm,y_mm\n0,0\n1,1\n2,0\n", "has 3 marks; a mirror map needs at least 4"),
        ("# c\n\nx_mm,y_mm\n0,0\n1,1\n2,0\n3\n", "line 7: '3': must be 2 finite numbers"),
        ("x_mm,y_mm,x_mrad,y_mrad\n0,0,0,0\n1,1,1,1\n2,0,2,0\n3,3,3,inf\n", "line 5: '3,3,3,inf': must be 4 finite"),
    ],
)
def test_given_a_spoilt_file_of_marks_then_it_is_one_line_with_file_and_line(tmp_path_factory, text, told):
    file = tmp_path_factory.mktemp("marks") / "marks.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as refused:
        read_fiducials(file)
    assert str(refused.value).startswith(f"{file}: ")
    assert told in str(refused.value)


MARKS = np.array([[0, 0], [80, 45], [-80, 45], [-80, -45], [80, -45], [100, 0], [-100, 0], [0, 60.0]])
MAP = MirrorMap(((1.02e-3, 3e-5, 0.01), (-2e-5, 0.97e-3, -0.005), (1e-4, -5e-5, 1.0)))

small = st.floats(-1, 1)


def angles(mirror_map, marks):
    return np.column_stack(mirror_map.angles_mrad(*marks.T))


def error_mm(found, true, marks=MARKS):
    """Where the beam falls that the found map sends to each mark, from the mark."""
    return np.hypot(*(np.column_stack(true.surface_mm(*found.angles_mrad(*marks.T))) - marks).T)


@given(st.tuples(*[small] * 8), st.booleans())
def test_given_marks_without_error_then_the_map_is_found_whatever_it_is(entries, flipped):
    spread = np.array([[3e-4, 3e-4, 0.05], [3e-4, 3e-4, 0.05], [5e-4, 5e-4, 0.0]])
    matrix = np.diag([1e-3, 1e-3, 1.0]) + spread * np.reshape([*entries, 0.0], (3, 3))
    matrix[0, 0] *= -1 if flipped else 1
    true = MirrorMap(tuple(map(tuple, matrix.tolist())))
    fit = fit_mirror_map(MARKS, angles(true, MARKS))
    assert fit.residual_mm.max() < 1e-6
    assert error_mm(fit.mirror_map, true).max() < 1e-6


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.5))
def test_given_marks_met_with_an_error_then_the_map_errs_no_more_than_they_do(seed, sigma_mm):
    rng = np.random.default_rng(seed)
    met = MARKS + rng.normal(0, sigma_mm, MARKS.shape)
    fit = fit_mirror_map(MARKS, angles(MAP, met))
    # 16 equations for 8 unknowns: half of the errors' energy is left over, and half goes into the map.
    assert fit.rms_mm < 3 * sigma_mm
    assert np.sqrt(np.mean(error_mm(fit.mirror_map, MAP) ** 2)) < 4 * sigma_mm


@pytest.mark.parametrize(
    ("marks", "told"),
    [
        (MARKS[:3], "needs at least 4"),
        (np.array([[-80, 0], [-30, 0], [30, 0], [80, 0.0]]), "on a line"),
        (np.array([[-80, 0], [0, 0], [80, 0], [0, 50.0]]), "on a line, or all but one"),
        (np.array([[-80, 20], [-40, 20.3], [0, 19.8], [40, 20.1], [80, 20.0]]), "on a line"),
        (np.zeros((4, 3)), "shapes"),
        (np.where(MARKS == 45, np.nan, MARKS), "not finite"),
    ],
)
def test_given_marks_that_decide_nothing_then_they_are_refused(marks, told):
    with pytest.raises(InputError, match=told):
        fit_mirror_map(marks, angles(MAP, np.nan_to_num(marks)) if marks.shape[1] == 2 else marks)


def test_given_two_marks_confused_then_they_are_refused_or_stick_out():
    met = angles(MAP, MARKS)
    met[[1, 3]] = met[[3, 1]]
    try:
        worst_mm = fit_mirror_map(MARKS, met).residual_mm.max()
    except InputError:
        return
    assert worst_mm > 20


def responses(factors, seed=0):
    """Bursts alike, each a little different, as at one distance on a plate with an edge."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(1500) / RATE_HZ
    common = np.exp(-60 * time_s) * np.sin(2 * np.pi * 180 * time_s)
    own = rng.normal(0, 0.05, (len(factors), 1500)) * np.exp(-60 * time_s)
    return np.array(factors)[:, None] * (common + own)


@given(st.lists(st.sampled_from([0.8, 1.0, 1.2, -1.0, 0.3, 0.0]), min_size=3, max_size=24), st.integers(0, 99))
def test_given_sound_ones_in_the_majority_then_each_gets_its_word(factors, seed):
    factors = factors + [1.0] * (len(factors) + 1)
    snr_db = np.where(np.array(factors) == 0, -10.0, 40.0)
    found = compare_actuators(responses(factors, seed), snr_db, RATE_HZ)
    words = {0.8: "good", 1.0: "good", 1.2: "good", -1.0: "reversed", 0.3: "weak", 0.0: "dead"}
    assert found.verdict == tuple(words[factor] for factor in factors)
    assert found.polarity == tuple(-1 if factor < 0 else 1 for factor in factors)
    assert np.isfinite(found.level_db).all()


def test_levels_are_told_against_the_median_and_without_any_signal_all_are_dead():
    found = compare_actuators(responses([1, 1, 2, 1, 0.5]), np.full(5, 50.0), RATE_HZ)
    assert found.level_db == pytest.approx([0, 0, 6.02, 0, -6.02], abs=0.3)
    found = compare_actuators(np.zeros((3, 100)), np.full(3, -300.0), RATE_HZ)
    assert found.verdict == ("dead",) * 3
    assert np.isfinite(found.level_db).all()


SHAPE = np.random.default_rng(3).normal(0, 0.15, 1500)


@pytest.mark.parametrize(
    ("green", "third"),
    [
        (responses([-1, -1, -1]), "good"),
        (np.vstack([responses([1, 1]), SHAPE, responses([1, 1], 1)]), "unlike"),
        # A magnet a few millimetres off.
        (np.vstack([responses([1, 1]), np.roll(-responses([1], 2), 9), responses([1, 1], 1)]), "reversed"),
    ],
    ids=["all reversed", "another shape", "another place"],
)
def test_given_another_sign_or_shape_then_it_is_told_by_the_majority(green, third):
    verdict = list(compare_actuators(green, np.full(len(green), 50.0), RATE_HZ).verdict)
    assert verdict.pop(2) == third
    assert set(verdict) == {"good"}
