"""The elastic solid against finite elements in plane strain, reciprocity and far fields."""

import numpy as np
import pytest
from scipy.sparse import block_array
from scipy.sparse.linalg import splu

from wavefocus.config.outline import Outline
from wavefocus.mocks.plates.soft import DampedWave, SolidPlate
from wavefocus.mocks.plates.stadium import Elements, spacing_mm, triangulate

DISK = Outline.of("disk", 90.0, 90.0)
KEYS = {"shear_speed_m_s": 5.0, "pressure_speed_m_s": 8.0, "damping_per_s": 2500.0}
"""So lossy that nothing comes back from the rim of the disk."""
SOURCE_MM = np.array([[4.0, -3.0]])
PLACE_MM = np.array([[-12.0, 9.0], [3.0, 21.0], [14.0, -3.0], [-2.0, -17.0], [5.5, -1.5]])


def _solved(elements, frequency_hz):
    """Velocity (places, oscillation, force) from the weak form of the paper's eq. (3) in units of rho c_s^2."""
    import skfem

    def gradients(of_u, of_v):
        return skfem.BilinearForm(lambda u, v, _: u.grad[of_u] * v.grad[of_v]).assemble(elements.basis)

    angular, shear, pressure = 2 * np.pi * frequency_hz, KEYS["shear_speed_m_s"], KEYS["pressure_speed_m_s"]
    modulus = 1 / (1 - 1j * KEYS["damping_per_s"] / angular)
    lame, mass = ((pressure / shear) ** 2 - 2) * modulus, (angular / shear) ** 2 * elements.mass
    xx, yy, xy, yx = gradients(0, 0), gradients(1, 1), gradients(1, 0), gradients(0, 1)
    system = block_array(
        [
            [(lame + 2 * modulus) * xx + modulus * yy - mass, lame * xy + modulus * yx],
            [lame * yx + modulus * xy, (lame + 2 * modulus) * yy + modulus * xx - mass],
        ]
    ).tocsc()
    load, count = elements.forces(SOURCE_MM)[:, 0], elements.mass.shape[0]
    forces = np.zeros((2 * count, 2), dtype=np.complex128)
    forces[:count, 0] = forces[count:, 1] = load
    # Symmetric, which an ordering for it halves the fill of.
    factors = splu(system, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    moved = factors.solve(forces)
    parts = [elements.values_at(PLACE_MM, np.asarray(part)) for part in (moved[:count], moved[count:])]
    return 1j * angular * np.stack(parts, axis=1)


def _plate(force_deg, oscillation_deg, source_mm=SOURCE_MM):
    return SolidPlate(source_mm, DISK, np.ones_like, **KEYS, force_deg=force_deg, oscillation_deg=oscillation_deg)


@pytest.mark.parametrize("frequency_hz", [pytest.param(60.0, marks=pytest.mark.nightly), 450.0])
def test_given_a_lossy_solid_then_the_tensor_is_that_of_finite_elements(frequency_hz):
    elements = Elements(triangulate(DISK, 0.5 * spacing_mm(DampedWave(5.0, 2500.0), 450.0)))
    solved = _solved(elements, frequency_hz)
    for force in (0, 1):
        for oscillation in (0, 1):
            plate = _plate(90.0 * force, 90.0 * oscillation)
            found = [plate.response(tuple(place), frequency_hz, 2, single=False)[0, 1] for place in PLACE_MM]
            wanted = solved[:, oscillation, force]
            assert np.linalg.norm(found - wanted) < 0.01 * np.linalg.norm(wanted), (force, oscillation)


def test_given_a_pressure_wave_that_is_too_slow_then_it_is_refused():
    with pytest.raises(ValueError, match=r"pressure_speed_m_s is 5; it must be above 5\.774"):
        SolidPlate(SOURCE_MM, DISK, np.ones_like, **KEYS | {"pressure_speed_m_s": 5.0})
