"""The bank between its positions by kernel regression, against the analytic plate, and nodes along paths."""

import functools

import numpy as np
import pytest

from tests.unit.plate_banks import SQUARE_MM, errors_at, plate_bank
from wavefocus.rendering.greens.interpolation.base import OffGridError
from wavefocus.rendering.greens.interpolation.kernel import KernelInterpolation
from wavefocus.rendering.greens.interpolation.path_nodes import PathNodes, node_spacing_mm
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.paths import Polyline, Strokes
from wavefocus.storage.errors import InputError

POINTS_MM = np.random.default_rng(1).uniform(-22.0, 22.0, (60, 2))


def hexagonal():
    grid = [(4.0 * x + 2.0 * (y % 2), 2.0 * np.sqrt(3.0) * y) for y in range(-7, 8) for x in range(-7, 7)]
    return np.array([point for point in grid if max(map(abs, point)) <= 26.0])


def jittered():
    return SQUARE_MM + np.random.default_rng(2).uniform(-1.0, 1.0, SQUARE_MM.shape)


def holed():
    return np.delete(SQUARE_MM, np.random.default_rng(3).choice(len(SQUARE_MM), 15, replace=False), axis=0)


GRIDS = {"square": SQUARE_MM, "hexagonal": hexagonal(), "irregular": jittered(), "with holes": holed()}


@functools.lru_cache
def kernel_on(grid="square", noise_db=None):
    bank = plate_bank(GRIDS[grid], noise_db=noise_db)
    return bank, KernelInterpolation(bank, POINTS_MM)


@functools.lru_cache
def greens_on(grid, noise_db):
    """Green's functions at the points of such a bank."""
    return greens_at(*kernel_on(grid, noise_db), POINTS_MM)


def greens_at(bank, kernel, points_mm):
    rows = kernel.nodes(points_mm).rows[:, 0]
    source = kernel.rows_of(bank)
    return np.stack([source.green(int(row)) for row in rows])


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize(("noise_db", "at_250_hz", "at_450_hz"), [(None, 0.005, 0.07), (-60.0, 0.01, 0.08)])
def test_between_the_positions_the_error_stays_within_the_marks(grid, noise_db, at_250_hz, at_450_hz):
    """notes: 0.5 and 7 %, with a bank at -60 dB 1 and 8 %; reached is about a tenth of that."""
    greens = greens_on(grid, noise_db)
    assert np.median(errors_at(250.0, greens, POINTS_MM)) < 0.25 * at_250_hz
    assert np.median(errors_at(450.0, greens, POINTS_MM)) < 0.05 * at_450_hz
    assert errors_at(450.0, greens, POINTS_MM).max() < at_450_hz


def test_interpolation_without_actuator_positions_or_band_is_as_good():
    bank, _ = kernel_on()
    bare = GreenArray(bank.values, bank.position_mm, bank.sample_rate_hz)
    greens = greens_at(bare, KernelInterpolation(bare, POINTS_MM), POINTS_MM)
    assert np.median(errors_at(250.0, greens, POINTS_MM)) < 0.005


def test_a_bank_in_another_unit_is_interpolated_to_the_same_rows_in_that_unit():
    (bank, _), scale = kernel_on(), 1e-12
    scaled = GreenArray(bank.values * scale, bank.position_mm, bank.sample_rate_hz, band_hz=bank.band_hz)
    expected = greens_at(bank, KernelInterpolation(bank, POINTS_MM[:8]), POINTS_MM[:4])
    found = greens_at(scaled, KernelInterpolation(scaled, POINTS_MM[:8]), POINTS_MM[:4])
    np.testing.assert_allclose(found / scale, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize(("grid", "noise_db"), [("square", -60.0), ("square", -40.0), ("irregular", -60.0)])
def test_error_found_by_leaving_positions_out_is_error_within_factor_of_two(grid, noise_db):
    bank, kernel = kernel_on(grid, noise_db)
    frequency_hz, greens = kernel.waves.frequency_hz, greens_on(grid, noise_db)
    relative = kernel.estimate(bank, POINTS_MM, frequency_hz).relative
    median, worst = np.median(relative, axis=1), relative.max(axis=1)
    for band in np.flatnonzero((frequency_hz >= 90.0) & (frequency_hz <= 460.0)):
        # The truth is known at the bins of the transform; between them the error hardly changes.
        true = errors_at(frequency_hz[band], greens, POINTS_MM)
        assert 0.5 < median[band] / np.median(true) < 2.5
        assert worst[band] > 0.4 * true.max()


def test_repeated_positions_are_merged():
    bank, _ = kernel_on()
    twice = GreenArray(
        np.concatenate([bank.values, bank.values[40:60]]),
        np.concatenate([bank.position_mm, bank.position_mm[40:60] + 1e-4]),
        bank.sample_rate_hz,
        band_hz=bank.band_hz,
    )
    kernel, once = KernelInterpolation(twice, POINTS_MM[:9]), KernelInterpolation(bank, POINTS_MM[:9])
    np.testing.assert_array_equal(greens_at(twice, kernel, POINTS_MM[:4]), greens_at(bank, once, POINTS_MM[:4]))


def test_rows_not_measured_or_poor_are_holes_that_the_others_fill():
    status = np.ones(len(SQUARE_MM), np.uint8)
    status[[70, 97]] = 0, 4
    bank = plate_bank(status=status)
    bank.values[70], bank.values[97] = 0.0, 1e3
    points_mm = SQUARE_MM[[70, 97]] + [[0.5, 0.2], [-0.3, 0.4]]
    greens = greens_at(bank, KernelInterpolation(bank, points_mm), points_mm)
    assert errors_at(250.0, greens, points_mm).max() < 0.02


def test_a_row_of_zeros_that_says_it_was_measured_is_refused_by_name():
    bank = plate_bank()
    bank.values[84] = 0.0
    with pytest.raises(InputError, match=r"position 84 at \(0, 0\) mm is all zeros"):
        KernelInterpolation(bank, np.array([[1.0, 1.0]]))


def test_too_few_positions_are_refused():
    bank = plate_bank(SQUARE_MM[[0, 1, 2, 13, 14, 15]])
    with pytest.raises(InputError, match="6 measured positions are too few"):
        KernelInterpolation(bank, SQUARE_MM[:1])


def test_an_arm_one_position_wide_is_refused_where_it_is():
    far = np.stack([np.arange(30) * 4.0 + 30.0, np.zeros(30)], axis=1)
    bank = plate_bank(np.concatenate([SQUARE_MM, far]))
    kernel = KernelInterpolation(bank, np.array([[1.0, 1.0]]))
    with pytest.raises(OffGridError, match=r"lies at \(130, 0\) mm, but position .* spread in two directions") as told:
        kernel.nodes(np.array([[2.0, 2.0], [130.0, 0.0]]))
    assert told.value.point == 1


def test_a_point_off_the_grid_is_refused():
    _, kernel = kernel_on()
    with pytest.raises(OffGridError, match=r"\(40, 0\) mm, 16 mm from"):
        kernel.nodes(np.array([[40.0, 0.0]]))


def interpolated(nodes, values, along):
    index, weights = nodes.weights(along)
    return (values[index] * weights).sum(axis=1)


def wave(points_mm, k=0.6, direction=0.4):
    return np.exp(-1j * k * (points_mm @ [np.cos(direction), np.sin(direction)]))


def test_corners_and_gaps_are_not_interpolated_across():
    square = Polyline([(0.0, 0.0), (20.0, 0.0), (20.0, 20.0), (0.0, 20.0)], closed=True)
    strokes = Strokes([np.array([[0.0, 0.0], [15.0, 0.0]]), np.array([[5.0, 9.0], [5.0, -9.0]])])
    for path in (square, strokes):
        nodes = PathNodes(path, node_spacing_mm(0.6, 1e-3))
        along = np.linspace(0.0, path.length_mm, 5003)[1:-1]
        found = interpolated(nodes, wave(path.point_at(nodes.arc_length_mm)), along)
        assert np.abs(found - wave(path.point_at(along))).max() < 5e-3
