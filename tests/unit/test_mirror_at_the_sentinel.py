"""A mirror that is off, by the sentinel position alone: a correction by control places would hide it."""

import numpy as np
import pytest

from tests.unit import analytic_plates
from wavefocus.rendering.verify.mirror_error import sentinel_shift_mm
from wavefocus.rendering.verify.results import Sentinel

SNR_DB = 50.0
ROWS = (14, 31, 48)
WAYS_MM = ((1.0, 0.0), (0.0, -1.0), (-1.0, 0.0), (0.7, 0.7), (-0.4, 0.3), (0.0, 0.0))


@pytest.mark.parametrize("plate", ["mirrors", "disk"])
def test_a_mirror_off_by_half_a_millimetre_or_one_is_found_in_every_direction(plate):
    rng, (bank, _) = np.random.default_rng(3), analytic_plates.lab(plate)
    for row in ROWS:
        places_mm = analytic_plates.places_mm(plate)[row] + np.array(WAYS_MM)
        for way_mm, green in zip(WAYS_MM, analytic_plates.green(plate, place_mm=places_mm), strict=True):
            level = 10 ** (-SNR_DB / 20) * np.linalg.norm(green, axis=1, keepdims=True) / np.sqrt(green.shape[1])
            seen = (green + level * rng.standard_normal(green.shape)).astype(np.float32)
            shift_mm = sentinel_shift_mm(Sentinel(row, seen, np.full(len(green), SNR_DB, np.float32)), bank)
            if not any(way_mm):
                assert shift_mm is None
            else:
                assert shift_mm is not None
                assert np.hypot(*(shift_mm - way_mm)) < 0.1
