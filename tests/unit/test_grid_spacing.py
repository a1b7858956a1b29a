"""What a grid's spacing costs, against errors measured on the analytic plate."""

from __future__ import annotations

import numpy as np
import pytest

from wavefocus.calibration.wave_model import PatchKernel, WaveModel
from wavefocus.mocks.plates.soft import SOFT_PLATE
from wavefocus.rendering.greens.interpolation.base import Neighbourhoods, interpolation_method
from wavefocus.rendering.greens.interpolation.needed_grid import expected_error, needed_grid, wave_number_rad_mm
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.storage.errors import InputError

ANGLES = 2.0 * np.pi * np.arange(20) / 20
ACTUATOR_MM = 90.0 * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
POINTS_MM = np.random.default_rng(0).uniform(-20.0, 20.0, (120, 2))
AREA_MM2 = 24_000.0


def wave_number(frequency_hz):
    return complex(SOFT_PLATE.wavenumber(frequency_hz)) / 1e3


def field(points_mm, frequency_hz):
    radius_mm = np.hypot(*(points_mm[:, None] - ACTUATOR_MM).transpose(2, 0, 1))
    return SOFT_PLATE.velocity(frequency_hz, radius_mm)


def grid(lattice, spacing_mm):
    steps = np.arange(-40, 41)
    x, y = (part.ravel() * spacing_mm for part in np.meshgrid(steps, steps))
    if lattice == "hexagonal":
        x, y = x + 0.5 * y, np.sqrt(0.75) * y
    position_mm = np.stack([x, y], axis=1)
    return position_mm[np.abs(position_mm).max(axis=1) < 42.0]


def measured_error(frequency_hz, spacing_mm, lattice, kind, trusted):
    """Relative rms error of the interpolation over points, the bank's own noise at -60 dB."""
    position_mm = grid(lattice, spacing_mm)
    rng = np.random.default_rng(1)
    values = field(position_mm, frequency_hz)
    noise = rng.standard_normal(values.shape) + 1j * rng.standard_normal(values.shape)
    values = values + 1e-3 / np.sqrt(2.0) * noise * np.sqrt(np.mean(np.abs(values) ** 2, axis=1, keepdims=True))
    truth = field(POINTS_MM, frequency_hz)
    if kind == "kernel":
        waves = WaveModel(
            np.ones(1), np.array([wave_number(frequency_hz)]), np.array([0.01 if trusted else 1.0]), np.array([1e-6])
        )
        neighbourhoods = Neighbourhoods(position_mm, np.ones(len(position_mm), dtype=bool))
        found = np.empty_like(truth)
        for place, row in enumerate(neighbourhoods.nearest(POINTS_MM)[0].tolist()):
            patch = neighbourhoods.patch(row)
            weights = PatchKernel(waves, patch.offset_mm).weights(POINTS_MM[place : place + 1] - position_mm[row])
            found[place] = weights[0, 0] @ values[patch.rows]
    else:
        nodes = interpolation_method(kind)(PositionGrid(position_mm)).nodes(POINTS_MM)
        found = np.einsum("pn,pna->pa", nodes.weights, values[nodes.rows])
    error = np.linalg.norm(found - truth, axis=1) / np.linalg.norm(truth, axis=1)
    return np.sqrt(np.mean(error**2))


@pytest.mark.parametrize(
    ("kind", "lattice", "trusted"),
    [
        ("nearest", "square", False),
        ("nearest", "hexagonal", False),
        ("bilinear", "square", False),
        ("bicubic", "square", False),
        ("kernel", "square", False),
        ("kernel", "hexagonal", False),
        ("kernel", "square", True),
        ("kernel", "hexagonal", True),
    ],
)
@pytest.mark.parametrize(("frequency_hz", "spacing_mm"), [(250.0, 5.0), (450.0, 3.0), (450.0, 5.0)])
def test_the_expected_error_is_the_measured_one(kind, lattice, trusted, frequency_hz, spacing_mm):
    expected = expected_error(
        wave_number(frequency_hz), spacing_mm, lattice=lattice, kind=kind, noise_db=-60.0, trusted=trusted
    )
    assert expected == pytest.approx(measured_error(frequency_hz, spacing_mm, lattice, kind, trusted), rel=0.2)


@pytest.mark.parametrize("kind", ["nearest", "bilinear", "bicubic", "kernel"])
@pytest.mark.parametrize("error", [0.03, 0.2])
def test_the_needed_grid_just_keeps_to_the_error(kind, error):
    k = wave_number(500.0)
    found = needed_grid(k, AREA_MM2, error, kind=kind)
    assert found.error == pytest.approx(error, rel=1e-3)
    assert expected_error(k, 1.05 * found.spacing_mm, kind=kind) > error
    assert found.positions == np.ceil(AREA_MM2 / found.spacing_mm**2)


@pytest.mark.parametrize("trusted", [False, True])
def test_a_hexagonal_grid_needs_fewer_positions_for_the_kernel(trusted):
    square, hexagonal = (
        needed_grid(wave_number(500.0), AREA_MM2, 0.05, lattice=lattice, trusted=trusted)
        for lattice in ("square", "hexagonal")
    )
    assert hexagonal.spacing_mm > square.spacing_mm
    assert hexagonal.positions < square.positions


def test_better_interpolations_get_by_with_fewer_positions():
    k = wave_number(450.0)
    positions = [needed_grid(k, AREA_MM2, 0.05, kind=kind).positions for kind in ("bilinear", "bicubic", "kernel")]
    assert positions == sorted(positions, reverse=True)
    assert needed_grid(k, AREA_MM2, 0.05, trusted=True).positions < positions[-1]


def test_spacing_scales_with_the_wave_length():
    once, twice = (needed_grid(complex(k, -0.0), AREA_MM2, 0.05).spacing_mm for k in (0.3, 0.6))
    assert once == pytest.approx(2.0 * twice, rel=1e-6)


def test_the_wave_number_of_a_speed_and_a_loss():
    assert wave_number_rad_mm(500.0, 5.0, 8.685889638) == pytest.approx(0.2 * np.pi - 0.1j)


def test_an_error_that_no_grid_keeps_to_is_refused():
    with pytest.raises(InputError, match=r"no grid keeps interpolation 'kernel' within 0\.1 %"):
        needed_grid(0.6 + 0j, AREA_MM2, 1e-3, noise_db=-40.0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"error": 0.0}, "error allowed is 0"),
        ({"area_mm2": -1.0}, "area to be covered is -1"),
        ({"wavenumber_rad_mm": 0.6 + 0.1j}, "Im k <= 0"),
        ({"kind": "cubic"}, "'cubic'; allowed are"),
        ({"kind": "bicubic", "lattice": "hexagonal"}, "square grid alone"),
    ],
)
def test_what_makes_no_sense_is_refused(wrong, message):
    given = {"wavenumber_rad_mm": 0.6 - 0.04j, "area_mm2": AREA_MM2, "error": 0.05, **wrong}
    with pytest.raises(InputError, match=message):
        needed_grid(**given)


@pytest.mark.parametrize("wrong", [(0.0, 5.0, 0.0), (100.0, -5.0, 0.0), (100.0, 5.0, -1.0)])
def test_a_wave_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(InputError, match=r"frequency_hz|speed_m_s|attenuation_db_per_cm"):
        wave_number_rad_mm(*wrong)
