"""Causes on plates by their own equations: each is named, or nothing is; never another. Symptoms in words."""

import itertools
from typing import get_args

import numpy as np
import pytest

from tests.unit import analytic_plates as plates
from tests.unit.analytic_plates import ACTUATORS, Medium, driven, green, verified
from wavefocus.rendering.verify.extra_measurements import QUIETER_DB
from wavefocus.rendering.verify.results import Symptom, SymptomCode, remedy, sentence


def certain(found):
    return {(symptom.code, symptom.actuators) for symptom in found.symptoms if symptom.certain}


def later(*case, mark=pytest.mark.long):
    """A case of `make test-all`."""
    return pytest.param(*case, marks=mark)


def nightly(*case):
    return later(*case, mark=pytest.mark.nightly)


@pytest.mark.parametrize(
    ("plate", "code", "actuators", "value"),
    [
        ("gel", "polarity", (4, 6), 0.0),
        later("bending", "silent", (7,), 0.0),
        later("disk", "level", (0, 1, 2, 5, 6, 7, 9, 11), 5.48),
        later("mirrors", "delay", (1, 10), 0.377),
        nightly("gel", "delay", (), -0.74),
        later("disk", "swapped", (0, 7), 0.0),
    ],
)
def test_given_an_electric_cause_then_just_its_actuators_are_named(plate, code, actuators, value):
    values = green(plate).copy()
    if code == "swapped":
        values[:, list(actuators)] = values[:, list(actuators[::-1])]
    else:
        factor = {"polarity": -1.0, "silent": 0.0, "level": 10 ** (value / 20), "delay": 1.0}[code]
        values = driven(values, actuators or tuple(range(ACTUATORS)), factor, value if code == "delay" else 0.0)
    found = verified(plate, values)
    assert certain(found) == {(code, actuators)}
    if code in ("level", "delay"):
        assert found.symptoms[0].value == pytest.approx(value, abs=0.5 if code == "level" else 0.05)
    assert not found.passed
    assert all(0.95 <= symptom.explained <= 1.0 for symptom in found.symptoms)


TURN = np.radians(4.34)


@pytest.mark.parametrize(
    ("plate", "matrix", "offset_mm"),
    [
        later("gel", np.eye(2), (-3.09, -3.09)),
        nightly("mirrors", np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]]), (0.0, 0.0)),
        later("disk", np.diag([1.18, 1.0]), (0.0, 0.0)),
    ],
    ids=["shift", "rotation", "scale of x"],
)
def test_given_a_mirror_that_is_off_then_one_affine_error_is_named_with_its_size(plate, matrix, offset_mm):
    moved = green(plate, Medium(), plates.places_mm(plate) @ matrix.T + offset_mm)
    (symptom,) = verified(plate, moved).symptoms
    assert (symptom.code, symptom.certain) == ("mirror", True)
    np.testing.assert_allclose(np.array(symptom.affine)[:, :2], matrix - np.eye(2), atol=0.01)
    np.testing.assert_allclose(np.array(symptom.affine)[:, 2], offset_mm, atol=0.1)
    assert symptom.value[0] == pytest.approx(float(np.hypot(*offset_mm)), abs=0.1)


@pytest.mark.long
def test_given_a_dead_actuator_and_faster_waves_then_these_two_are_named():
    values = green("gel", Medium(speed=1.02)) * (np.arange(ACTUATORS) != 5)[:, None]
    found = verified("gel", values)
    assert certain(found) == {("silent", (5,)), ("speed", ())}
    (speed,) = (symptom.value for symptom in found.symptoms if symptom.code == "speed")
    assert speed == pytest.approx(2.0, abs=0.2)


FOUR_LEVELS = np.append([1.3, 0.75, 1.4, 0.8], np.ones(ACTUATORS - 4))[:, None]
UNNAMED = {
    "damping": lambda plate: (green(plate, Medium(loss=2.0)),),
    "cubic": lambda plate: (green(plate), 0.6),
    "finger": lambda plate: (green(plate, Medium(mass=0.04 if plate == "mirrors" else 1e-3, mass_mm=(-11.0, 8.0))),),
    "four causes at once": lambda plate: (FOUR_LEVELS * green(plate),),
}


@pytest.mark.parametrize(
    ("plate", "cause"),
    [
        later("mirrors", "damping"),
        later("bending", "finger"),
        later("gel", "four causes at once"),
        *(nightly(*case) for case in (("mirrors", "cubic"), ("mirrors", "finger"), ("bending", "damping"))),
        nightly("bending", "cubic"),
    ],
)
def test_given_a_cause_without_a_name_then_nothing_is_named_and_no_guess_made(plate, cause):
    found = verified(plate, *UNNAMED[cause](plate))
    codes = [symptom.code for symptom in found.symptoms if not symptom.certain]
    assert len(codes) == len(found.symptoms)
    if cause == "four causes at once":
        assert (codes, found.passed) == (["unexplained"], False)
    assert codes in ([], ["unexplained"])


def test_given_a_scene_played_quieter_then_distortion_is_named_by_it_alone():
    assert certain(verified("gel", *UNNAMED["cubic"]("gel"), quiet_db=QUIETER_DB)) == {("nonlinear", ())}


@pytest.mark.long
def test_given_the_bank_of_another_plate_then_it_is_called_wrong():
    other = green("disk") * np.linalg.norm(green("gel")) / np.linalg.norm(green("disk"))
    (symptom,) = verified("gel", other).symptoms
    assert (symptom.code, symptom.certain) == ("wrong_bank", False)  # a heavy finger on a stiff plate looks the same


@pytest.mark.parametrize("plate", ["gel", *map(nightly, ("mirrors", "disk", "bending"))])
def test_given_a_sound_rig_then_nothing_is_named(plate):
    found = verified(plate, green(plate))
    assert found.symptoms == ()
    assert found.fields.error < 0.01
    assert all(abs(one.level_db) < 0.1 and abs(one.delay_us) < 10.0 for one in found.actuators)


def test_given_any_code_then_it_has_a_sentence_and_a_remedy_and_states_its_values():
    for code, actuators in itertools.product(get_args(SymptomCode), ((), (3,), (1, 4, 5))):
        symptom = Symptom(code, actuators, 1.5, 0.4, certain=False, shift_mm=(1.0, 0.0))
        text = sentence(symptom)
        assert text.endswith(".")
        assert remedy(symptom).endswith(".")
        assert "nan" not in text
        if code not in ("unexplained", "wrong_bank", "crosstalk"):
            assert "40 %" in text  # as records of earlier versions have guesses
    affine = ((0.05, 0.0, -1.5), (0.0, 0.0, 0.0))
    assert sentence(Symptom("mirror", (), (1.5, 0.0, 0.0247), 0.99, affine=affine)) == (
        "The mirror is off: each position shows the field shifted by (-1.5, +0) mm, rotated by +0° about the centre"
        " (counter-clockwise is positive) and scaled by +5 % in x and +0 % in y."
    )
    guess = Symptom("level", (), 0.2, 0.4, certain=False)
    assert sentence(guess) == (
        "Best guess, which explains 40 % of the excess: all responses are 0.20 dB louder than in the bank."
    )
