"""The projective map between surface and mirror angles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.calibration.mirror_map import MirrorMap
from wavefocus.storage.errors import InputError

OBLIQUE = MirrorMap(((2.1e-3, 1e-4, 0.02), (-5e-5, 1.9e-3, -0.01), (2e-4, -1e-4, 1.0)))
places = st.floats(-200, 200)


def test_straight_beam_obeys_the_tangent() -> None:
    x_mrad, y_mrad = MirrorMap.straight(500.0).angles_mrad([100.0, 500.0], [-50.0, 0.0])
    assert x_mrad == pytest.approx([1000 * np.arctan(0.2), 1000 * np.pi / 4])
    assert y_mrad == pytest.approx([1000 * np.arctan(-0.1), 0.0])


@given(places, places)
def test_a_place_comes_back_from_its_angles(x_mm: float, y_mm: float) -> None:
    assert OBLIQUE.surface_mm(*OBLIQUE.angles_mrad(x_mm, y_mm)) == pytest.approx((x_mm, y_mm), abs=1e-8)


@pytest.mark.parametrize(
    "matrix",
    [
        ((0, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((1e-3, 2e-3, 0), (2e-3, 4e-3, 0), (0, 0, 1)),
        ((1, 0, 0), (0, float("nan"), 0), (0, 0, 1)),
        ((1, 0), (0, 1), (0, 0)),
    ],
)
def test_a_matrix_that_cannot_be_turned_round_is_refused(matrix: tuple[tuple[float, ...], ...]) -> None:
    with pytest.raises(InputError, match="mirror map matrix"):
        MirrorMap(matrix)  # type: ignore[arg-type]


def test_a_place_behind_the_mirror_is_refused() -> None:
    tilted = MirrorMap(((1e-3, 0, 0), (0, 1e-3, 0), (1e-2, 0, 1)))
    with pytest.raises(InputError, match="-200"):
        tilted.angles_mrad(-200.0, 0.0)


@pytest.mark.parametrize("distance_mm", [0.0, -1.0, float("nan")])
def test_a_distance_that_is_none_is_refused(distance_mm: float) -> None:
    with pytest.raises(InputError, match="distance_mm"):
        MirrorMap.straight(distance_mm)
