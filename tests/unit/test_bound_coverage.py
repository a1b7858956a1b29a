"""Bounds between positions of coarse grids hold on plates of others: disk, mirror images, glass, finite elements.

`python -m pytest -s -m nightly tests/unit/test_bound_coverage.py` prints the table of docs/explanation/coarse-grids.md.
"""

import sys
from functools import partial

import numpy as np
import pytest
from scipy.special import h2vp, hankel2, jv, jvp

from wavefocus.calibration.coarse_grid.bounds import judged
from wavefocus.calibration.coarse_grid.rim_waves import RimWaves
from wavefocus.calibration.coarse_grid.waves import Dispersion, distances_mm

SHOWN_HZ = (100.0, 250.0, 450.0)
HZ = np.array([25.0, 60.0, 100.0, 105.0, 110.0, 180.0, 250.0, 255.0, 270.0, 380.0, 450.0, 455.0, 495.0])
SHOWN = [int(np.flatnonzero(one == HZ)[0]) for one in SHOWN_HZ]
GEL, LOW_LOSS = Dispersion(250.0, 4750.0, 420.0, 0.05, 0.2), Dispersion(250.0, 5200.0, 90.0)
SIZE_MM = np.array([220.0, 140.0])
POINTS, CHECKS, DRAWS, ACTUATORS = 300, 24, 20, 12


def disk(k, hz, points_mm, sources_mm, radius_mm=85.0):
    """A disk with a free rim: H0 and what the rim adds, order by order (addition theorem)."""
    r, at = np.hypot(*points_mm.T), np.arctan2(*points_mm.T[::-1])
    source_r, source_at = np.hypot(*sources_mm.T), np.arctan2(*sources_mm.T[::-1])
    found = hankel2(0, k * distances_mm(points_mm, sources_mm))
    for order in range(-60, 61):
        added = -jv(order, k * source_r) * h2vp(order, k * radius_mm) / jvp(order, k * radius_mm)
        found = found + jv(order, k * r)[:, None] * added * np.exp(1j * order * (at[:, None] - source_at))
    return found


def mirror_images(reflection, k, hz, points_mm, sources_mm):
    """A rectangle whose rim reflects a part: waves of the images of each source."""
    found = np.zeros((len(points_mm), len(sources_mm)), complex)
    for number in np.stack(np.meshgrid(*[np.arange(-5, 6)] * 2), axis=-1).reshape(-1, 2):
        image_mm = number * SIZE_MM + np.where(number % 2 == 0, 1.0, -1.0) * sources_mm
        found += reflection ** np.abs(number).sum() * hankel2(0, k * distances_mm(points_mm, image_mm))
    return found


def glass(k, hz, points_mm, sources_mm):
    """Bending waves of a simply supported rectangle: the sum of its modes."""
    bending, number, shapes = 0.0424 * np.sqrt(hz / 450.0), np.arange(1, 60), []
    for at_mm in (points_mm, sources_mm):
        x, y = (np.sin(np.pi * np.outer(at / size + 0.5, number)) for at, size in zip(at_mm.T, SIZE_MM, strict=True))
        shapes.append(x[:, :, None] * y[:, None, :])
    square = np.square(np.pi * number / SIZE_MM[0])[:, None] + np.square(np.pi * number / SIZE_MM[1])
    return np.einsum("pmn,amn,mn->pa", *shapes, 1e-6 / (square**2 - bending**4 * (1 - 0.02j)), optimize=True)


def ellipse(k, hz, points_mm, sources_mm):
    """A membrane of 115 x 75 mm (half axes) that is held at its rim, by finite elements of second order."""
    import skfem
    from scipy.sparse.linalg import splu
    from skfem.models.poisson import laplace, mass

    mesh = skfem.MeshTri.init_circle(6)
    mesh = mesh.with_boundaries({"rim": lambda x: np.hypot(*x) > 1.0 - 1e-9}).scaled((115.0, 75.0))
    basis = skfem.Basis(mesh, skfem.ElementTriP2())
    system = (laplace.assemble(basis) - k**2 * mass.assemble(basis)).tocsc()
    inner = basis.complement_dofs(basis.get_dofs("rim"))
    load, seen = (basis.probes(at_mm.T).tocsc()[:, inner] for at_mm in (sources_mm, points_mm))
    return seen @ splu(system[inner][:, inner]).solve(load.T.toarray().astype(complex))


def outline(count, offset_mm):
    """Points on a stadium of 250 x 150 mm, moved outwards, and its normals there, (count, 2) each."""
    radius_mm = 75.0 + offset_mm
    along = (np.arange(count) + 0.5) / count * (200.0 + 2 * np.pi * radius_mm)
    places, normals = np.empty((2, count, 2))
    for index, at in enumerate(along):
        half, rest = divmod(at, 100.0 + np.pi * radius_mm)
        turn = max(rest - 100.0, 0.0) / radius_mm - np.pi / 2
        normal = np.array([np.cos(turn), np.sin(turn)])
        place = radius_mm * normal + [min(rest, 100.0) - 50.0, 0.0]
        places[index], normals[index] = (place, normal) if half == 0 else (-place, -normal)
    return places, normals


def stadium(k, hz, points_mm, sources_mm):
    """A stadium with a free rim, by fundamental solutions (Fairweather and Karageorghis, 1998)."""
    rim_mm, normal = outline(900, 0.0)
    outer_mm, _ = outline(420, 9.0)

    def slope(from_mm):
        gap_mm = rim_mm[:, None] - from_mm
        far_mm = np.hypot(gap_mm[..., 0], gap_mm[..., 1])
        return k * h2vp(0, k * far_mm) * (gap_mm * normal[:, None]).sum(axis=2) / far_mm

    by_source = slope(outer_mm)
    scale = np.linalg.norm(by_source, axis=0)
    strength = np.linalg.lstsq(by_source / scale, -slope(sources_mm), rcond=1e-13)[0] / scale[:, None]
    own = hankel2(0, k * distances_mm(points_mm, sources_mm))
    return own + hankel2(0, k * distances_mm(points_mm, outer_mm)) @ strength


PLATES = {
    "disk, Bessel series": (disk, GEL, (75.0, 75.0)),
    "rectangle, mirror images": (partial(mirror_images, -0.8), GEL, (95.0, 57.0)),
    "the same, low loss": (partial(mirror_images, 0.6), LOW_LOSS, (95.0, 57.0)),
    "glass, modes": (glass, GEL, (95.0, 57.0)),
    "ellipse, finite elements": (ellipse, GEL, (100.0, 62.0)),
    "stadium, fundamental solutions": (stadium, GEL, (110.0, 64.0)),
}
"""Response at a wave number, the law of the waves, and half axes of the ellipse that positions keep to."""


def cells(plate, spacing_mm, noise_db):
    """Error, expected error and coverage at three frequencies, means of 20 draws of 24 check positions."""
    response, law, half_mm = PLATES[plate]
    turn = 2.0 * np.pi * (np.arange(ACTUATORS) + 0.3) / ACTUATORS
    actuator_mm = 1.06 * np.array(half_mm) * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    grid_mm = np.stack(np.meshgrid(*[np.arange(-20, 21) * spacing_mm + 0.3 * spacing_mm] * 2), -1).reshape(-1, 2)
    grid_mm = grid_mm[np.hypot(*(grid_mm / half_mm).T) <= 1.0]
    rng = np.random.default_rng(7)
    random_mm = rng.uniform(-1.0, 1.0, (4 * POINTS, 2))
    random_mm = random_mm[np.hypot(*random_mm.T) <= 1.0] * half_mm
    check, there = slice(len(grid_mm), len(grid_mm) + 10 * CHECKS), slice(len(grid_mm) + 10 * CHECKS, None)
    places_mm = np.vstack([grid_mm, random_mm[POINTS : POINTS + 10 * CHECKS], random_mm[:POINTS]])
    truth = np.stack([response(law.wavenumber(np.array([hz]))[0], hz, places_mm, actuator_mm) for hz in HZ])
    noise = 10.0 ** (noise_db / 20.0) * np.sqrt(np.square(np.abs(truth)).mean(axis=0))
    noise[check] /= 2.0  # a check position is the mean of four
    seen = truth + noise * rng.standard_normal((*truth.shape, 2)).view(complex)[..., 0] / np.sqrt(2.0)
    model = RimWaves.fit(HZ, grid_mm, actuator_mm, seen[:, : check.start], workers=1)
    deviations = model.deviations(places_mm[there], SHOWN)
    missed = np.abs(model.values(places_mm[there], SHOWN) - truth[SHOWN, there])
    size = np.linalg.norm(truth[SHOWN, there], axis=2)
    coverage, expected, rng = np.zeros((DRAWS, 3)), np.zeros((DRAWS, 3)), np.random.default_rng(5)
    for draw in range(DRAWS):
        some = check.start + rng.permutation(10 * CHECKS)[:CHECKS]
        stated = judged(model, places_mm[some], seen[:, some], noise[some], 5.0, lambda all_, do: [do(n) for n in all_])
        coverage[draw] = (missed <= stated["bound_scale"][SHOWN, None, None] * deviations).mean(axis=(1, 2))
        wrong = np.linalg.norm(stated["error_scale"][SHOWN, None, None] * deviations, axis=2)
        expected[draw] = np.median(wrong / size, axis=1)
    error = np.median(np.linalg.norm(missed, axis=2) / size, axis=1)
    return error, np.median(expected, axis=0) / error, coverage.mean(axis=0)


@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_bounds_hold_for_95_percent_of_places_on_six_plates_of_others():
    covered, ratios = [], []
    for plate in PLATES:
        for spacing_mm, noise_db in ((10.0, -60.0), (20.0, -60.0), (10.0, -40.0)):
            error, ratio, coverage = cells(plate, spacing_mm, noise_db)
            covered, ratios = [*covered, *coverage], [*ratios, *ratio]
            for hz, *row in zip(SHOWN_HZ, error, ratio, 100.0 * coverage, strict=True):
                figures = " ".join(f"{one:9.4g}" for one in row)
                sys.stdout.write(f"\n{plate:31} {spacing_mm:3g} mm {noise_db:g} dB {hz:g} Hz {figures}")
    assert np.count_nonzero((np.array(covered) >= 0.9) & (np.array(covered) <= 0.98)) >= 50
    assert min(covered) >= 0.85
    assert (np.abs(np.log2(ratios)) <= 1.0).all()
