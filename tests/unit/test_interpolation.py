"""The bank between its positions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.rendering.greens.interpolation.base import OffGridError, interpolation_method
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.storage.errors import InputError

LATTICE = np.array([(4.0 * x, 4.0 * y) for y in range(5) for x in range(6)])


def brute(position_mm, points_mm):
    offset = points_mm[:, None] - position_mm[None]
    return np.argmin(offset[..., 0] ** 2 + offset[..., 1] ** 2, axis=1)


@given(seed=st.integers(0, 2**31), positions=st.integers(1, 60), step=st.sampled_from([0.01, 0.5, 30.0]))
def test_the_nearest_row_is_found_along_any_path(seed, positions, step):
    rng = np.random.default_rng(seed)
    position_mm = rng.uniform(-20, 20, (positions, 2))
    points_mm = np.cumsum(step * rng.standard_normal((500, 2)), axis=0)
    rows, distance_mm = PositionGrid(position_mm).nearest(points_mm)
    np.testing.assert_array_equal(rows, brute(position_mm, points_mm))
    np.testing.assert_allclose(distance_mm, np.hypot(*(points_mm - position_mm[rows]).T))


@given(seed=st.integers(0, 2**31))
def test_on_a_tie_the_lower_index_is_nearest(seed):
    rng = np.random.default_rng(seed)
    position_mm = rng.permutation(LATTICE)
    points_mm = 2.0 * rng.integers(0, [11, 9], (300, 2))
    rows, _ = PositionGrid(position_mm).nearest(points_mm)
    np.testing.assert_array_equal(rows, brute(position_mm, points_mm))


def test_a_point_further_than_one_spacing_is_refused_with_place_and_distance():
    nearest = interpolation_method("nearest")(PositionGrid(LATTICE))
    assert nearest.nodes(np.array([[-4.0, 0.0]])).rows.tolist() == [[0]]
    with pytest.raises(OffGridError, match=r"\(-4\.1, 0\) mm, 4\.1 mm from") as caught:
        nearest.nodes(np.array([[0.0, 0.0], [-4.1, 0.0]]))
    assert caught.value.point == 1


@given(seed=st.integers(0, 2**31))
def test_bilinear_weights_are_exact_for_a_bilinear_field(seed):
    rng = np.random.default_rng(seed)
    a, b, c, d = rng.standard_normal(4)
    position_mm = rng.permutation(LATTICE) - (7.0, 3.0)
    x, y = position_mm.T
    field = a + b * x + c * y + d * x * y
    points_mm = rng.uniform((-7, -3), (13, 13), (50, 2))
    nodes = interpolation_method("bilinear")(PositionGrid(position_mm)).nodes(points_mm)
    found = (field[nodes.rows] * nodes.weights).sum(axis=1)
    x, y = points_mm.T
    np.testing.assert_allclose(found, a + b * x + c * y + d * x * y, atol=1e-10)
    np.testing.assert_array_equal(nodes.nearest, brute(position_mm, points_mm))


def test_on_a_position_bilinear_gives_that_row_alone_even_at_the_rim():
    nodes = interpolation_method("bilinear")(PositionGrid(LATTICE)).nodes(LATTICE)
    used = np.abs(nodes.weights) > 1e-12
    assert (used.sum(axis=1) == 1).all()
    np.testing.assert_array_equal(nodes.rows[used], np.arange(len(LATTICE)))


def test_bilinear_is_refused_in_a_cell_that_lacks_a_corner():
    holed = np.delete(LATTICE, 8, axis=0)
    kind = interpolation_method("bilinear")(PositionGrid(holed))
    with pytest.raises(OffGridError, match="lacks a corner"):
        kind.nodes(np.array([[6.0, 2.0]]))
    assert kind.nodes(np.array([[2.0, 2.0]])).weights.tolist() == [[0.25] * 4]
    with pytest.raises(OffGridError, match="lacks a corner"):
        kind.nodes(np.array([[-1.0, 2.0]]))


@pytest.mark.parametrize(
    ("position_mm", "message"),
    [
        (np.array([[0, 0], [4, 0], [8, 0]]), "same y"),
        (np.array([[0, 0], [0, 4]]), "same x"),
        (np.array([[0, 0], [4, 0], [0, 4], [4.7, 4], [8, 0]]), "regular"),
        (np.random.default_rng(0).uniform(0, 100, (50, 2)), "regular"),
    ],
)
def test_bilinear_is_refused_on_a_grid_that_is_not_a_lattice(position_mm, message):
    with pytest.raises(InputError, match=message):
        interpolation_method("bilinear")(PositionGrid(position_mm))


@pytest.mark.parametrize("position_mm", [np.zeros((0, 2)), np.zeros((3, 3)), [[0.0, np.nan]]])
def test_positions_that_are_none_are_refused(position_mm):
    with pytest.raises(InputError):
        PositionGrid(position_mm)
