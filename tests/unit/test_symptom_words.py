"""Symptoms in words."""

from typing import get_args

import pytest

from wavefocus.rendering.verify.results import Symptom, SymptomCode, remedy, sentence


@pytest.mark.parametrize("code", get_args(SymptomCode))
@pytest.mark.parametrize("actuators", [(), (3,), (1, 4, 5)])
def test_given_any_code_then_it_has_a_sentence_and_a_remedy(code, actuators):
    symptom = Symptom(code, actuators, 1.5, 0.4, certain=False, shift_mm=(1.0, 0.0))
    text = sentence(symptom)
    assert text.endswith(".")
    assert remedy(symptom).endswith(".")
    assert "nan" not in text
    if code not in ("unexplained", "wrong_bank", "crosstalk"):
        assert "40 %" in text  # as records of earlier versions have guesses


def test_error_of_mirror_then_shift_turn_and_scale_of_each_axis_are_stated():
    affine = ((0.05, 0.0, -1.5), (0.0, 0.0, 0.0))
    assert sentence(Symptom("mirror", (), (1.5, 0.0, 0.0247), 0.99, affine=affine)) == (
        "The mirror is off: each position shows the field shifted by (-1.5, +0) mm, rotated by +0° about the centre"
        " (counter-clockwise is positive) and scaled by +5 % in x and +0 % in y."
    )


def test_given_a_best_guess_then_the_sentence_says_how_much_it_explains():
    guess = Symptom("level", (), 0.2, 0.4, certain=False)
    assert sentence(guess) == (
        "Best guess, which explains 40 % of the excess: all responses are 0.20 dB louder than in the bank."
    )
