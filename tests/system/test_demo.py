"""The errors that the demo states."""

import numpy as np
import pytest

from wavefocus.commands.demo import norms_of_errors
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.virtual.settings import VirtualSettings
from wavefocus.rendering.greens.source import GreenArray


def test_given_a_known_error_of_some_places_then_it_is_stated():
    rig = VirtualRig(VirtualSettings())
    places_mm = np.array([[3.0, 4.0], [-21.0, 7.5], [40.0, -12.0]])
    true = np.stack([rig.truth(x_mm, y_mm, 2000) for x_mm, y_mm in places_mm])
    bank = GreenArray(true, places_mm, 10_000.0, band_hz=(20.0, 500.0))
    green = (row * gain for row, gain in zip(true, (1.0, 1.1, 0.99), strict=True))
    wrong, right = norms_of_errors(bank, rig, places_mm, green)
    assert wrong.shape == right.shape == (3, 20)
    assert (wrong[0] < 1e-5 * right[0]).all()
    assert wrong[1] / right[1] == pytest.approx(0.1, rel=1e-3)
    assert wrong[2] / right[2] == pytest.approx(0.01, rel=1e-3)
