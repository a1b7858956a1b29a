"""Waves of a coarse grid on plates of other shapes, and with a finger on them: small, and the stated errors say so."""

import numpy as np
import pytest

from wavefocus.acquisition.grid import check_grid, surface_grid
from wavefocus.calibration.coarse_grid.rim_waves import RimWaves
from wavefocus.calibration.neighbour_judge import RowsPredicted
from wavefocus.config.outline import Outline
from wavefocus.mocks.plates.making import make_plate

STEP_HZ, BINS = 50.0, 10
USED = [3, 5, 7, 9]
"""150 to 450 Hz: 10 mm are 0.4 to 1.1 wavelengths."""
SPACING_MM, MARGIN_MM = 10.0, 10.0
FINGER = {"place_mm": (12.0, -7.0), "mass_kg": 1e-3, "damping_n_s_m": 0.5, "stiffness_n_m": 300.0}
CASES = {
    "polygon": ("stadium", Outline.polygon([(70, -40), (60, 45), (-20, 60), (-70, 10), (-45, -50)]), {}),
    "disk": ("stadium", Outline.of("disk", 130.0, 130.0), {}),
    "a finger on a gel": ("soft", Outline.stadium(160.0, 110.0), {"finger": FINGER}),
}


@pytest.mark.nightly
@pytest.mark.parametrize("name", CASES)
def test_waves_hold_on_other_shapes_and_beneath_a_finger_and_their_bounds_say_so(name):
    kind, outline, keys = CASES[name]
    actuator_mm = outline.at(outline.perimeter_mm * (np.arange(6) + 0.3) / 6) * 0.93
    plate = make_plate(kind, actuator_mm, outline, np.ones_like, keys)
    rng = np.random.default_rng(3)

    def responses(points_mm, noise=0.0):
        found = np.stack([plate.response(tuple(place), STEP_HZ, BINS, single=False) for place in points_mm])
        part = rng.standard_normal((2, *found.shape))
        found = found + noise / np.sqrt(2) * np.abs(found) * (part[0] + 1j * part[1])
        return (found if found.shape[1] == 6 else found.transpose(0, 2, 1))[..., USED].transpose(2, 0, 1)

    position_mm = surface_grid(outline, MARGIN_MM, SPACING_MM)
    check_mm = check_grid(outline, MARGIN_MM, SPACING_MM, position_mm, 24)
    points_mm = rng.uniform(*np.reshape(outline.box_mm, (2, 2)), (400, 2))
    points_mm = points_mm[outline.contains(points_mm, MARGIN_MM)][:50]
    hz, measured = STEP_HZ * np.array(USED), responses(position_mm, 1e-3)
    model = RimWaves.fit(hz, position_mm, actuator_mm, measured, check_mm, responses(check_mm, 1e-3), workers=1)
    truth, values = responses(points_mm), model.values(points_mm)
    error = np.linalg.norm(values - truth, axis=2) / np.linalg.norm(truth, axis=2)
    deviations = model.deviations(points_mm, range(len(hz)))
    expected = model.error_scale[:, None] * np.linalg.norm(deviations, axis=2) / np.linalg.norm(truth, axis=2)
    within = np.abs(values - truth) <= model.bound_scale[:, None, None] * deviations
    assert model.stated == 0.95
    # The kernel, each position left out.
    rows = measured.transpose(1, 2, 0)
    kernel = RowsPredicted(position_mm, rows, hz, np.ones(len(position_mm), dtype=bool))
    errors = np.linalg.norm(kernel.errors_without(np.zeros(len(position_mm), dtype=bool))[0], axis=1) / np.linalg.norm(
        rows, axis=1
    )
    missed = errors[sorted(kernel.patches)]
    assert np.median(error[-1]) < 0.06
    assert np.median(missed, axis=0)[-1] > 0.4
    assert (np.median(expected, axis=1) > np.median(error, axis=1) / 3).all()
    assert within.mean() > 0.85
