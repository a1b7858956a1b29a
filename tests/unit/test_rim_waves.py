"""Waves between the positions of a coarse grid, against exact fields of sources and of a circular rim."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import h2vp, hankel2, jv, jvp

from wavefocus.calibration.coarse_grid.bounds import judged
from wavefocus.calibration.coarse_grid.rim_waves import RimWaves
from wavefocus.calibration.coarse_grid.waves import Dispersion, distances_mm

RADIUS_MM = 55.0
RNG = np.random.default_rng(4)
ANGLE = 2 * np.pi * np.arange(5) / 5
ACTUATOR_MM = 50.0 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=1)
FREQUENCY_HZ = np.array([300.0, 450.0])
LAW = Dispersion(250.0, 4750.0, 420.0)


def lattice(spacing_mm, radius_mm=45.0):
    side = np.arange(-6, 7) * spacing_mm + 0.3
    points = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    return points[np.hypot(*points.T) < radius_mm]


def disk_response(k, points_mm, sources_mm):
    """A point source in a disk with a free rim: H0 and what the rim adds, order by order (addition theorem)."""
    r, at = np.hypot(*points_mm.T), np.arctan2(*points_mm.T[::-1])
    source_r, source_at = np.hypot(*sources_mm.T), np.arctan2(*sources_mm.T[::-1])
    found = hankel2(0, k * distances_mm(points_mm, sources_mm))
    for order in range(-50, 51):
        added = -jv(order, k * source_r) * h2vp(order, k * RADIUS_MM) / jvp(order, k * RADIUS_MM)
        found = found + jv(order, k * r)[:, None] * added * np.exp(1j * order * (at[:, None] - source_at))
    return found


@pytest.fixture(scope="module")
def coarse():
    """A disk, positions 11 mm apart (k times spacing up to 6.5), noise of -60 dB."""
    position_mm = lattice(11.0)
    transfer = np.stack([disk_response(k, position_mm, ACTUATOR_MM) for k in LAW.wavenumber(FREQUENCY_HZ)])
    noise = RNG.standard_normal((2, *transfer.shape))
    return position_mm, transfer * (1 + 1e-3 / np.sqrt(2) * (noise[0] + 1j * noise[1]))


@pytest.fixture(scope="module")
def random_mm():
    points = RNG.uniform(-42, 42, (200, 2))
    return points[np.hypot(*points.T) < 42]


def test_waves_of_a_disk_are_found_beyond_the_spatial_nyquist_limit(coarse, random_mm):
    position_mm, transfer = coarse
    checks_mm = random_mm[:12]
    wavenumber = LAW.wavenumber(FREQUENCY_HZ)
    check = np.stack([disk_response(k, checks_mm, ACTUATOR_MM) for k in wavenumber])
    model = RimWaves.fit(FREQUENCY_HZ, position_mm, ACTUATOR_MM, transfer, checks_mm, check, workers=1)
    points_mm = random_mm[12:]
    values, bounds = model.values(points_mm), model.bound_scale[:, None, None] * model.deviations(points_mm, range(2))
    assert abs(model.wavenumber[-1]) * model.spacing_mm > 1.9 * np.pi
    assert model.stated == 0.9
    assert np.allclose(model.wavenumber, wavenumber, rtol=2e-3)
    for number, k in enumerate(wavenumber):
        truth = disk_response(k, points_mm, ACTUATOR_MM)
        error = np.linalg.norm(values[number] - truth, axis=1) / np.linalg.norm(truth, axis=1)
        assert np.median(error) < 0.05
        assert np.quantile(error, 0.9) < 0.15
        assert 0.8 < (np.abs(values[number] - truth) < bounds[number]).mean() <= 1.0
    assert model.pressure_share == 0.0


def plate_noise(rng, *shape):
    part = rng.standard_normal((2, *shape))
    return (part[0] + 1j * part[1]) / np.sqrt(2)


@pytest.fixture(scope="module")
def unchecked(coarse):
    """A model that no check position judges."""
    position_mm, transfer = coarse
    model = RimWaves.fit(FREQUENCY_HZ[1:], position_mm, ACTUATOR_MM, transfer[1:], workers=1)
    assert (model.stated, model.judged_by, np.isnan(model.bound_scale).all()) == (0.0, "left-out positions", True)
    return model


@pytest.mark.long
def test_too_few_check_positions_then_no_bound_is_stated(coarse, random_mm):
    position_mm, transfer = coarse
    checks_mm = random_mm[:11]
    check = disk_response(LAW.wavenumber(FREQUENCY_HZ)[1], checks_mm, ACTUATOR_MM)[None]
    model = RimWaves.fit(FREQUENCY_HZ[1:], position_mm, ACTUATOR_MM, transfer[1:], checks_mm, check, workers=1)
    assert np.isnan(model.bound_scale).all()


@pytest.mark.parametrize(("checks", "stated"), [pytest.param(12, 0.9, marks=pytest.mark.long), (24, 0.95)])
def test_bounds_hold_the_stated_share_of_errors_without_the_noise_of_the_checks(unchecked, random_mm, checks, stated):
    """Errors four times as large as the guide says, with measurements as noisy as they are large: limited by noise."""
    model = unchecked
    rng, deviation = np.random.default_rng(6), model.deviations(random_mm, [0])
    truth = model.values(random_mm) + 4.0 * deviation * plate_noise(rng, *deviation.shape)
    nu = 4.0 * np.median(deviation)
    covered, scales, by_noise = [], [], []
    for _ in range(12):
        some = rng.permutation(len(random_mm))[:checks]
        seen = truth[:, some] + nu * plate_noise(rng, 1, checks, len(ACTUATOR_MM))
        level = np.full((checks, len(ACTUATOR_MM)), nu)
        facts = judged(model, random_mm[some], seen, level, 0.0, lambda at, task: [task(one) for one in at])
        found = replace(model, **facts)
        assert (found.stated, found.judged_by) == (stated, "check positions")
        covered.append((np.abs(truth - model.values(random_mm)) <= found.bound_scale[:, None, None] * deviation).mean())
        scales.append(found.error_scale[0])
        by_noise.append(found.by_noise[0])
    assert np.median(scales) == pytest.approx(4.0, rel=0.2)
    assert np.median(by_noise) > 0.02
    assert np.mean(covered) == pytest.approx(stated, abs=0.05)


def test_sizes_and_too_few_positions_are_refused(coarse):
    position_mm, transfer = coarse
    with pytest.raises(ValueError, match="transfer has shape"):
        RimWaves.fit(FREQUENCY_HZ, position_mm, ACTUATOR_MM, transfer[:, 1:])
    with pytest.raises(ValueError, match="too few"):
        RimWaves.fit(FREQUENCY_HZ, position_mm[:8], ACTUATOR_MM, transfer[:, :8])


def scattered(count, radius_mm=45.0):
    rng = np.random.default_rng(11)
    points = rng.uniform(-radius_mm, radius_mm, (2000, 2))
    points = points[np.hypot(*points.T) < radius_mm]
    chosen = points[:1]
    for place in points:
        if len(chosen) < count and np.hypot(*(chosen - place).T).min() > 7.0:
            chosen = np.vstack([chosen, place])
    return chosen


SHIFT_MM = 3.0 * np.array([[1, 0], [0, 1], [-0.7, 0.7], [0.7, 0.7], [-1, 0]])
MISSING = np.random.default_rng(2).permutation(51)[:5]
STIFF = {
    "one actuator": {"actuators": slice(0, 1)},
    "actuators whose place is wrong by 3 mm": {"shift_mm": SHIFT_MM},
    "10 % of the positions missing": {"position_mm": np.delete(lattice(11.0), MISSING, axis=0)},
    "random positions": {"position_mm": scattered(51)},
    "noise of 20 dB": {"noise": 0.1, "worst": 0.2},
    "a wave speed that depends on direction": {"stretch": 1.15, "worst": 3.0},
}
STIFF_HZ = np.array([350.0])


LONG = (
    "one actuator",
    "noise of 20 dB",
    "10 % of the positions missing",
    "random positions",
    "a wave speed that depends on direction",
)


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.long] * (name in LONG)) for name in STIFF])
def test_the_expected_error_tells_the_true_one_in_stiff_cases(name, random_mm):
    """At one frequency, k times spacing 5.1: the error is small, or the model says that it is not."""
    case = STIFF[name]
    position_mm, points_mm = case.get("position_mm", lattice(11.0)), random_mm
    actuators = case.get("actuators", slice(None))
    squeezed = np.array([case.get("stretch", 1.0), 1.0])  # waves along x are slower by this
    k = LAW.wavenumber(STIFF_HZ)[0]

    def measured(at_mm):
        if case.get("stretch"):
            return hankel2(0, k * distances_mm(at_mm * squeezed, ACTUATOR_MM[actuators] * squeezed))
        return disk_response(k, at_mm, ACTUATOR_MM[actuators])

    rng, noise = np.random.default_rng(5), case.get("noise", 1e-3)

    def noisy(values):
        part = rng.standard_normal((2, *values.shape))
        rms = np.sqrt(np.square(np.abs(values)).mean(axis=0))
        return (values + noise / np.sqrt(2) * rms * (part[0] + 1j * part[1]))[None]

    places_mm = (ACTUATOR_MM + case.get("shift_mm", 0.0))[actuators]
    checks_mm, points_mm = points_mm[:12], points_mm[12:]
    model = RimWaves.fit(
        STIFF_HZ, position_mm, places_mm, noisy(measured(position_mm)), checks_mm, noisy(measured(checks_mm)),
        workers=1,
    )  # fmt: skip
    truth = measured(points_mm)
    error = np.linalg.norm(model.values(points_mm)[0] - truth, axis=1) / np.linalg.norm(truth, axis=1)
    deviations = model.deviations(points_mm, [0])[0]
    expected = model.error_scale[0] * np.linalg.norm(deviations, axis=1) / np.linalg.norm(truth, axis=1)
    assert np.median(error) < case.get("worst", 0.1)
    # Said, not hidden: what is expected is at least a third of what is true.
    assert np.median(expected) > np.median(error) / 3
    within = np.abs(model.values(points_mm)[0] - truth) < model.bound_scale[0] * deviations
    assert within.mean() > 0.75


@pytest.mark.long
def test_a_plate_of_glass_measured_at_few_frequencies_gets_waves_of_the_plate_s_size():
    hz = np.array([25.0, 60.0, 100.0, 105.0, 110.0, 180.0, 250.0, 255.0, 270.0, 380.0, 450.0, 455.0, 495.0])
    size_mm, number = np.array([220.0, 140.0]), np.arange(1, 40)
    turn = 2.0 * np.pi * (np.arange(12) + 0.3) / 12
    actuator_mm = np.stack([101.0 * np.cos(turn), 60.0 * np.sin(turn)], axis=1)
    place_mm = lattice(20.0, 1e3)
    place_mm = place_mm[np.hypot(*(place_mm / [95.0, 57.0]).T) <= 1.0]
    shapes = [
        np.sin(np.pi * np.outer(at_mm[:, axis] / size_mm[axis] + 0.5, number))
        for at_mm in (place_mm, actuator_mm)
        for axis in (0, 1)
    ]
    square = np.square(np.pi * number / size_mm[0])[:, None] + np.square(np.pi * number / size_mm[1])
    modes = [1.0 / (square**2 - (0.0424 * np.sqrt(one / 450.0)) ** 4 * (1 - 0.02j)) for one in hz]
    transfer = np.array([np.einsum("pm,pn,am,an,mn->pa", *shapes, mode, optimize=True) for mode in modes])
    noise = RNG.standard_normal((*transfer.shape, 2)).view(complex)[..., 0] * 1e-3 / np.sqrt(2)
    noise *= np.sqrt(np.square(np.abs(transfer)).mean(axis=0))
    model = RimWaves.fit(hz, place_mm, actuator_mm, transfer + noise, workers=1)
    values = model.values(place_mm)
    assert np.linalg.norm(values - transfer) < 0.05 * np.linalg.norm(transfer)
    assert 2 * np.pi / np.abs(model.wavenumber).max() < 24 * np.hypot(*size_mm)
