"""Grids, lists of positions, and rows as people type them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavefocus.acquisition.grid import check_grid, read_positions_file, surface_grid
from wavefocus.config.outline import Outline
from wavefocus.input_files import parse_positions
from wavefocus.storage.errors import InputError

PLATE = Outline.stadium(250.0, 150.0)


def test_default_grid_has_the_papers_1500_positions_in_rows_of_alternating_direction():
    grid = surface_grid(PLATE, 14.3, 4)
    assert grid.shape == (1500, 2)
    step_mm = np.diff(grid, axis=0)
    same_row = step_mm[:, 1] == 0
    assert np.all(np.abs(step_mm[same_row, 0]) == 4)
    assert np.all(step_mm[~same_row, 1] == 4)
    rows = [grid[grid[:, 1] == y_mm, 0] for y_mm in np.unique(grid[:, 1])]
    directions = [np.sign(row[1] - row[0]) for row in rows]
    assert directions == [1 if index % 2 == 0 else -1 for index in range(len(rows))]


@settings(max_examples=10)
@given(width_mm=st.floats(5, 100), extra_mm=st.floats(0, 100), margin=st.floats(0, 0.45), spacing_mm=st.floats(1, 8))
def test_any_grid_fills_the_inset_stadium_and_stays_in_it(width_mm, extra_mm, margin, spacing_mm):
    length_mm, margin_mm = width_mm + extra_mm, margin * width_mm
    plate = Outline.stadium(length_mm, width_mm)
    try:
        grid = surface_grid(plate, margin_mm, spacing_mm)
    except InputError:  # no position left: then the middle pair of columns is outside
        assert not plate.contains([spacing_mm / 2, 0], margin_mm)
        return
    half_mm, radius_mm = (length_mm - width_mm) / 2, width_mm / 2 - margin_mm
    beyond_mm = np.maximum(np.abs(grid[:, 0]) - half_mm, 0)
    assert np.all(np.hypot(beyond_mm, grid[:, 1]) <= radius_mm + 2e-6)
    # The same lattice, far larger than the surface, holds no further point inside.
    reach = math.ceil(length_mm / spacing_mm) + 2
    index = np.arange(-reach, reach + 1)
    lattice = np.stack(np.meshgrid((index + 0.5) * spacing_mm, index * spacing_mm), axis=-1)
    assert len(grid) == np.count_nonzero(plate.contains(lattice, margin_mm))
    assert len(np.unique(grid, axis=0)) == len(grid)


@settings(max_examples=10)
@given(spacing_mm=st.floats(8.0, 40.0), margin_mm=st.floats(0.0, 30.0))
def test_any_hexagonal_grid_has_six_neighbours_at_one_spacing_and_fills_the_stadium(spacing_mm, margin_mm):
    grid_mm = surface_grid(PLATE, margin_mm, spacing_mm, "hexagonal")
    assert PLATE.contains(grid_mm, margin_mm).all()
    distance_mm = np.hypot(*(grid_mm[:, None] - grid_mm).transpose(2, 0, 1))
    distance_mm[np.diag_indices(len(grid_mm))] = np.inf
    assert distance_mm.min() > spacing_mm * (1 - 1e-9)
    inner = PLATE.contains(grid_mm, margin_mm + 1.01 * spacing_mm)
    near = np.isclose(distance_mm, spacing_mm, rtol=1e-9).sum(axis=1)
    assert np.all(near[inner] == 6)


@settings(max_examples=10)
@given(width_mm=st.floats(10, 200), extra_mm=st.floats(0, 200), count=st.integers(1, 60))
def test_any_rim_lies_on_the_outline_with_equal_arcs(width_mm, extra_mm, count):
    outline, radius_mm = Outline.stadium(width_mm + extra_mm, width_mm), width_mm / 2
    fine = outline.at(np.arange(count * 2000) * outline.perimeter_mm / (count * 2000))
    beyond_mm = np.maximum(np.abs(fine[:, 0]) - extra_mm / 2, 0)
    np.testing.assert_allclose(np.hypot(beyond_mm, fine[:, 1]), radius_mm, rtol=1e-9)
    chord_mm = np.linalg.norm(np.diff(fine, axis=0, append=fine[:1]), axis=1)
    perimeter_mm = 2 * extra_mm + 2 * math.pi * radius_mm
    np.testing.assert_allclose(chord_mm.reshape(count, 2000).sum(axis=1), perimeter_mm / count, rtol=1e-4)


def test_given_outlines_then_area_depth_and_points_within_are_theirs():
    assert PLATE.area_mm2 == pytest.approx(np.pi * 75.0**2 + 100.0 * 150.0)
    assert Outline.of("disk", 80.0, 80.0).area_mm2 == pytest.approx(np.pi * 1600.0)
    depth = Outline.rectangle(100.0, 50.0).depth_mm([[0, 0], [49, 0], [60, 0], [45, -24]])
    assert depth == pytest.approx([25.0, 1.0, -10.0, 1.0])
    corner = Outline.polygon([(0, 0), (50, 0), (50, 20), (20, 20), (20, 50), (0, 50)])
    assert corner.area_mm2 == pytest.approx(1600.0)
    assert corner.contains([[10, 40], [30, 30], [40, 10]]).tolist() == [True, False, True]
    assert (surface_grid(corner, 3.0, 4.0) >= 3.0).all()


def test_positions_file_is_read_in_its_own_order(tmp_path):
    file = tmp_path / "grid.csv"
    file.write_bytes(b"\xef\xbb\xbf# from the bench\r\nx_mm, y_mm\r\n\r\n3.5, -2\r\n-1e1,0\r\n")
    assert read_positions_file(file, PLATE).tolist() == [[3.5, -2], [-10, 0]]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "line 1: must be the header x_mm,y_mm"),
        ("1,2\n", "line 1: must be the header x_mm,y_mm"),
        ("x_m,y_m\n1,2\n", "line 1: must be the header x_mm,y_mm"),
        ("x_mm,y_mm\n", "holds no position"),
        ("x_mm,y_mm\n1,2\n3\n", "line 3: '3': must be 2 finite numbers"),
        ("x_mm,y_mm\n1;2\n", "line 2: '1;2': must be 2 finite numbers"),
        ("x_mm,y_mm\n1,2,3\n", "line 2: '1,2,3': must be 2 finite numbers"),
        ("x_mm,y_mm\nnan,2\n", "line 2: 'nan,2': must be 2 finite numbers"),
        ("x_mm,y_mm\n1e999,2\n", "line 2: '1e999,2': must be 2 finite numbers"),
        ("x_mm,y_mm\n1,2\n\n1.0,2\n", "line 4: (1, 2) mm repeats line 2"),
        ("x_mm,y_mm\n0,0\n0,76\n", "line 3: (0, 76) mm lies outside the surface"),
        ("x_mm,y_mm\n1,\xff\n", "line 2: not UTF-8"),
    ],
)
def test_mistake_in_a_positions_file_names_file_and_line(tmp_path, text, complaint):
    file = tmp_path / "grid.csv"
    file.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError) as told:
        read_positions_file(file, PLATE)
    assert str(told.value).startswith(f"{file}: {complaint}")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("outline", [Outline.stadium(250.0, 150.0), Outline.rectangle(120.0, 80.0)])
@pytest.mark.parametrize("count", [0, 1, 60])
def test_check_positions_lie_between_grid_inside_margin_and_are_always_same(outline, count):
    position_mm = surface_grid(outline, 14.3, 10.0)
    found = check_grid(outline, 14.3, 10.0, position_mm, count)
    assert found.shape == (count, 2)
    assert outline.contains(found, 14.3).all()
    gap_mm = np.hypot(*(found[:, None] - position_mm).transpose(2, 0, 1))
    assert count == 0 or (gap_mm.min() >= 1.0 and gap_mm.min(axis=1).max() <= 10.0)
    assert len(np.unique(found, axis=0)) == count
    np.testing.assert_array_equal(found, check_grid(outline, 14.3, 10.0, position_mm, count))


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("3", [3]), ("3,5-7", [3, 5, 6, 7]), (" 0 , 9 ", [0, 9]), ("2,2,1-2", [2, 1]), ("0-9", list(range(10))),
        *((wrong, None) for wrong in ("", "a", "1,,2", "-1", "10", "3-10", "7-3", "1.5", "1;2", "9" * 30)),
    ],
)  # fmt: skip
def test_numbers_and_ranges_name_each_row_once_and_anything_else_is_one_sentence(text, rows):
    if rows is not None:
        assert parse_positions(text, 10) == rows
        return
    with pytest.raises(InputError, match="--positions") as told:
        parse_positions(text, 10)
    assert "\n" not in str(told.value)
