"""One cause at a time on a simulated plate: it is named, or nothing is; never another."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.unit.line_verification import rendered, scan_of
from wavefocus.benchmarks import symptoms as simulated
from wavefocus.benchmarks.symptoms import SymptomCase, lab, outcome
from wavefocus.rendering.verify.linearity import QUIETER_DB, nonlinear_share
from wavefocus.rendering.verify.scan import Scan

ACTUATORS = simulated.ACTUATORS


def chance(number: int = 1) -> np.random.Generator:
    return np.random.default_rng([7, number])


@pytest.mark.parametrize(
    "cause",
    [simulated.delay_of_all, simulated.rotated, simulated.damping, simulated.cubic_drive],
)
def test_given_a_cause_then_it_is_named_with_certainty(cause) -> None:
    case = cause(lab("soft"), chance())
    found = lab("soft").verified(case, chance())
    (symptom,) = found.symptoms
    assert (symptom.code, symptom.certain) == (case.code, True)
    assert 0.8 <= symptom.explained <= 1.0


@pytest.mark.parametrize("count", [4, 5, 6])
def test_given_some_actuators_3_db_quieter_then_just_they_are_named(count: int) -> None:
    chosen = tuple(sorted(chance(count).permutation(ACTUATORS)[:count].tolist()))
    factor = np.ones(ACTUATORS)
    factor[list(chosen)] = 10 ** (-3.0 / 20.0)
    case = SymptomCase("level", "level", chosen, lab("soft").truth * factor[:, None])
    (symptom,) = lab("soft").verified(case, chance()).symptoms
    assert (symptom.code, symptom.actuators, symptom.certain) == ("level", chosen, True)
    assert symptom.value == pytest.approx(-3.0, abs=0.1)


def test_given_reversed_silent_and_late_actuators_then_each_kind_is_named() -> None:
    factor = np.ones(ACTUATORS)
    factor[[1, 4]], factor[7] = -1.0, 0.0
    case = SymptomCase("several", None, None, lab("soft").truth * factor[:, None])
    found = lab("soft").verified(case, chance()).symptoms
    assert {(one.code, one.actuators, one.certain) for one in found} == {
        ("polarity", (1, 4), True),
        ("silent", (7,), True),
    }


def test_given_a_finger_then_the_error_is_unexplained_and_a_guess_is_no_more_than_a_guess() -> None:
    case = simulated.finger(lab("soft"), chance())
    found = lab("soft").verified(case, chance())
    assert found.symptoms[0].code == "unexplained"
    assert not any(symptom.certain for symptom in found.symptoms)
    assert outcome(case, found) == "unexplained"


def test_given_a_cubic_of_half_per_square_volt_then_it_is_no_level() -> None:
    case = simulated.cubic_response(lab("soft"), chance())
    case = dataclasses.replace(case, respond=lambda response: response + 0.5 * response**3)
    (symptom,) = lab("soft").verified(case, chance(), again=False).symptoms
    assert symptom.code == "nonlinear"


def test_given_a_sound_rig_then_nothing_is_named() -> None:
    found = lab("soft").verified(SymptomCase("none", None, None, lab("soft").truth), chance())
    assert found.symptoms == ()
    assert found.passed


@pytest.mark.parametrize(("exponent", "share"), [(3, 1.0), (1, 0.0)])
def test_given_the_scene_played_quieter_then_it_shows_how_much_of_the_difference_is_distortion(
    exponent: int, share: float
) -> None:
    _, prediction = rendered()
    loudest = float(np.abs(prediction.field).max())

    def played(factor: float) -> Scan:
        field = prediction.field / factor
        field = field + 0.5 * loudest * (field / loudest) ** exponent
        return scan_of(field, prediction.start_s, prediction.sample_rate_hz, 0.0)

    found = nonlinear_share(prediction, played(1.0), played(10 ** (QUIETER_DB / 20.0)), (50.0, 500.0))
    assert found == pytest.approx(share, abs=0.02)
