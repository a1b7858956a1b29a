"""The procedures with a person at the bench: cables forgotten, outputs given up, marks that stick out."""

from dataclasses import replace

import numpy as np
import pytest

from tests.lab_files import setup_of
from wavefocus.acquisition.calibrate_channels import (
    NotMeasuredError,
    Probe,
    listening_places,
    measure_actuators,
    measure_inputs,
    measure_outputs,
)
from wavefocus.acquisition.calibrate_mirror import read_fiducials, suspect_mark
from wavefocus.calibration.mirror_map import MirrorMap, fit_mirror_map
from wavefocus.config.messages.rig_checks import Here
from wavefocus.config.outline import Outline, default_marks_mm
from wavefocus.mocks.virtual.rig import RigFault, VirtualRig, VirtualSettings
from wavefocus.storage.errors import InputError

RATE_HZ = 10_000.0
ACTUATORS = ((110.0, 0.0), (40.0, 66.0), (-40.0, 66.0))


class Hands:
    """A person who forgets some cables, and tries so often before giving up."""

    def __init__(self, rig, *, forgets=(), patience=5):
        self._bay, self._forgets, self._patience = rig.patch_bay, list(forgets), patience
        self.plugged: list[str] = []
        self.problems: list[str] = []

    def report(self, line):
        pass

    def connect(self, source):
        self.plugged.append(source)
        if source in self._forgets:
            self._forgets.remove(source)
            return
        self._bay.connect(source)

    def jog(self, view):
        return Here()

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


@pytest.mark.parametrize("patience", [1, 5])
def test_the_loopback_in_place_of_the_summing_box_then_nothing_is_measured_by_it(patience):
    rig, _, probe = bench()
    rig.patch_bay.connect("both")
    hands = Hands(rig, forgets=("sum",), patience=patience)
    if patience == 1:
        with pytest.raises(NotMeasuredError):
            outputs(probe, hands, 0.0)
    else:
        assert len(outputs(probe, hands, 0.0)) == 4
        assert hands.plugged == ["sum", "sum"]


def test_an_input_that_hears_the_same_cable_more_softly_then_the_inputs_are_refused():
    rig, _, probe = bench(fault_plan=(RigFault("recorder", "read", "drift", at_call=1, count=3, level_db=-3.0),))
    with pytest.raises(NotMeasuredError, match=r"the same cable -29\.\d % apart: check cables and terminal"):
        measure_inputs(probe, Hands(rig))


def test_given_no_loopback_then_nothing_is_measured_and_it_says_why():
    rig, _, probe = bench(output_gain=(1.0, 1.0, 1.0, 0.0))
    with pytest.raises(NotMeasuredError, match="no signal from the loopback at the reference input"):
        measure_inputs(probe, Hands(rig, patience=1))
    with pytest.raises(NotMeasuredError, match="no signal from the loopback at the reference input"):
        outputs(probe, Hands(rig, patience=1))


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
    faults = (RigFault("player", "wait", "underflow", at_call=2), RigFault("recorder", "read", "short_read", at_call=4))
    rig, _, probe = bench(fault_plan=faults)
    assert measure_inputs(probe, Hands(rig)).late_s == pytest.approx(5e-6, abs=1e-7)


def test_given_speckle_in_a_record_then_the_actuator_is_heard_again():
    fault = RigFault("recorder", "read", "dropout", position=1, attempt=1)
    _, setup, _ = bench(fault_plan=(fault,))
    found = measure_actuators(listening_places(np.array(ACTUATORS), 30.0), 1.0, RATE_HZ, setup)
    assert found.verdict == ("good",) * 3
    assert np.abs(found.level_db).max() < 2 * 2.0


def test_given_a_response_too_loud_then_the_actuator_is_named():
    _, setup, _ = bench()
    places = listening_places(np.array(ACTUATORS), 30.0)
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
        ("x,y\n0,0\n", "line 1: must be the header"),
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
