"""The errors that the demo states."""

import numpy as np
import pytest

from wavefocus.benchmarks.rig_bank import compare_with_truth
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.virtual.settings import VirtualSettings
from wavefocus.rendering.greens.source import GreenArray


def test_given_a_known_error_of_some_places_then_it_is_stated():
    rig = VirtualRig(VirtualSettings())
    places_mm = np.array([[3.0, 4.0], [-21.0, 7.5], [40.0, -12.0]])
    true = np.stack([rig.truth(x_mm, y_mm, 2000) for x_mm, y_mm in places_mm])
    green = true * np.array([1.0, 1.1, 0.99])[:, None, None]
    bank = GreenArray(green, places_mm, 10_000.0, status=np.ones(3, np.uint8), band_hz=(20.0, 500.0))
    error_db = compare_with_truth(bank, rig)
    assert error_db.shape == (3, 20)
    assert (error_db[0] < -100.0).all()
    assert error_db[1] == pytest.approx(-20.0, abs=0.01)
    assert error_db[2] == pytest.approx(-40.0, abs=0.01)
