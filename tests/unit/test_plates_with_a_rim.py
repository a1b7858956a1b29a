"""Plates whose rim reflects waves, and the solid, against closed forms and against all their finite elements."""

import numpy as np
import pytest
from scipy.sparse import block_array
from scipy.sparse.linalg import splu
from scipy.special import h2vp, hankel2, jv, jvp

from wavefocus.benchmarks.plate import ThinPlate
from wavefocus.config.outline import Outline
from wavefocus.mocks.plates import thin
from wavefocus.mocks.plates.soft import MAGNET_RADIUS_MM, SOFT_PLATE, DampedWave, SolidPlate
from wavefocus.mocks.plates.stadium import Elements, StadiumPlate, spacing_mm, triangulate
from wavefocus.mocks.plates.thin import KAPPA_M2_S, ThinRectangle
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.virtual.settings import VirtualSettings

HIGHEST_HZ = 500.0
SPACING_MM = spacing_mm(SOFT_PLATE, HIGHEST_HZ)
DISK_MM = 40.0
SOURCE_MM = np.array([[30.0, 0.0], [5.0, -8.0]])
PLACE_MM = np.array([[-20.0, 11.0], [0.0, 24.0], [12.0, -3.0], [-33.0, -2.0]])
STADIUM = Outline.stadium(70.0, 40.0)
SKEW = Outline.polygon([(40.0, -5.0), (25.0, 20.0), (-35.0, 20.0), (-32.0, -18.0), (30.0, -20.0)])
"""Mirrors itself in no axis."""
ACTUATOR_MM = np.array([[26.0, 0.0], [0.0, 13.0], [-24.0, -5.0]])


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WAVEFOCUS_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def _mean_over_disk(k):
    argument = k * MAGNET_RADIUS_MM / 1e3
    return complex(2 * jv(1, argument) / argument)


def _disk_response(k, place_mm, source_mm, rim):
    """The field of a small disk in a round plate with dy/dn = -rim y: a series over angle (Graf's theorem)."""
    (place, source), radius = (np.hypot(*point) / 1e3 for point in (place_mm, source_mm)), DISK_MM / 1e3
    angle = np.arctan2(place_mm[1], place_mm[0]) - np.arctan2(source_mm[1], source_mm[0])
    total = 0j
    for m in range(61):
        away = (k * h2vp(m, k * radius) + rim * hankel2(m, k * radius)) / (
            k * jvp(m, k * radius) + rim * jv(m, k * radius)
        )
        near, far = sorted((place, source))
        term = jv(m, k * near) * (hankel2(m, k * far) - away * jv(m, k * far))
        total += (1 if m == 0 else 2) * np.cos(m * angle) * term
    return complex(-0.25j * total * _mean_over_disk(k))


def test_given_a_round_plate_then_the_elements_agree_with_its_closed_form():
    disk = Elements(triangulate(Outline.stadium(2 * DISK_MM, 2 * DISK_MM), SPACING_MM))
    for admittance, frequency_hz in ((0.0, 450.0), (1.0, 250.0), (1.0, 450.0)):
        k = complex(SOFT_PLATE.wavenumber(frequency_hz))
        rim = 2j * np.pi * frequency_hz * admittance / SOFT_PLATE.speed_m_s
        solved = disk.values_at(PLACE_MM, disk.inverse(SOFT_PLATE, admittance, frequency_hz)(disk.forces(SOURCE_MM)))
        exact = np.array([[_disk_response(k, place, source, rim) for source in SOURCE_MM] for place in PLACE_MM])
        assert np.linalg.norm(solved - exact) < 5e-3 * np.linalg.norm(exact)


@pytest.mark.parametrize(
    ("outline", "admittance"),
    [
        (STADIUM, 0.7),
        (SKEW, 0.0),
        pytest.param(STADIUM, 0.0, marks=pytest.mark.long),
        pytest.param(Outline.rectangle(70.0, 40.0), 0.7, marks=pytest.mark.long),
    ],
)
def test_given_a_plate_with_a_rim_then_its_responses_are_those_of_all_elements(outline, admittance):
    elements = Elements(triangulate(outline, 0.7 * SPACING_MM))
    plate = StadiumPlate(ACTUATOR_MM, outline, np.ones_like, rim_admittance=admittance)
    response = plate.response((-8.0, 3.0), 50.0, 11, single=False)
    assert np.abs(response[:, 0]).max() < 1e-5 * np.abs(response).max()
    for place in (1, 5, 10):
        solved = elements.inverse(SOFT_PLATE, admittance, 50.0 * place)(elements.forces(ACTUATOR_MM))
        velocity = 2j * np.pi * 50.0 * place * elements.values_at(np.array([[-8.0, 3.0]]), solved)[0]
        assert np.linalg.norm(response[:, place] - velocity) < 3e-3 * np.linalg.norm(velocity)
    single = plate.response((-8.0, 3.0), 50.0, 11, single=True)
    assert single.dtype == np.complex64
    assert np.linalg.norm(single - response) < 1e-5 * np.linalg.norm(response)


def test_an_actuator_in_the_middle_then_the_plate_moves_alike_in_all_its_quarters():
    plate = StadiumPlate(np.array([[0.0, 0.0]]), STADIUM, np.ones_like)
    first, *others = (plate.response((x, y), 50.0, 11, single=False) for x in (-9.0, 9.0) for y in (-4.0, 4.0))
    assert np.abs(first).max() > 0
    for other in others:
        np.testing.assert_array_equal(other, first)


def test_given_taps_then_the_spectra_are_those_of_the_cut_responses():
    plate = StadiumPlate(ACTUATOR_MM, STADIUM, lambda hertz: 1 / (1 + 1j * hertz / 800.0) ** 4)
    rate_hz, taps, length = 10_000.0, 400, 512
    spectra = plate.fir_spectra(PLACE_MM[:2] / 2, taps, rate_hz, length, slice(3, 30))
    full = 4 * 2700  # the plate's slowest motion decays within a second
    for place, found in zip(PLACE_MM[:2] / 2, spectra, strict=True):
        response = plate.response(tuple(place), rate_hz / full, full // 2 + 1, single=False)
        wanted = np.fft.rfft(np.fft.irfft(response, full)[:, :taps], length)[:, 3:30]
        assert np.linalg.norm(found - wanted) < 1e-6 * np.linalg.norm(wanted)


def test_given_a_plate_of_before_then_it_is_read_and_a_damaged_file_is_replaced(tmp_path, monkeypatch):
    monkeypatch.setenv("WAVEFOCUS_CACHE", str(tmp_path))

    def response():
        plate = StadiumPlate(ACTUATOR_MM / 2, Outline.stadium(40.0, 40.0), np.ones_like)
        return plate.response((0.0, 0.0), 100.0, 6, single=False)

    first = response()
    (file,) = tmp_path.iterdir()
    content = file.read_bytes()
    second = response()
    assert file.read_bytes() == content
    file.write_bytes(content[:1000])
    third = response()
    assert len(file.read_bytes()) == len(content)
    # The first has shapes in double precision.
    assert np.linalg.norm(second - first) < 1e-6 * np.linalg.norm(first)
    assert np.linalg.norm(third - first) < 1e-6 * np.linalg.norm(first)


def test_a_rectangle_of_glass_then_its_responses_are_the_sum_of_its_modes_in_time():
    outline, rate_hz, samples = Outline.rectangle(250.0, 150.0), 40_000.0, 40_000
    plate = ThinRectangle(np.array([[60.0, 30.0]]), outline, np.ones_like, quality=80.0)
    response = plate.response((-40.0, 10.0), rate_hz / samples, 501, single=False)[0]
    corner_mm = np.array([125.0, 75.0])
    rung = ThinPlate(0.25, 0.15, KAPPA_M2_S).impulse_velocity(
        (np.array([[-40.0, 10.0]]) + corner_mm) / 1e3, (np.array([[60.0, 30.0]]) + corner_mm) / 1e3,
        samples, rate_hz, quality=80.0, band_hz=(0.0, thin.HIGHEST_HZ),
    )[0, 0]  # fmt: skip
    spectrum = thin.STRENGTH * np.fft.rfft(rung)[:501] / rate_hz
    assert np.linalg.norm(response - spectrum) < 0.01 * np.linalg.norm(spectrum)


def test_given_glass_that_rings_for_seconds_then_its_response_does_not_wrap():
    keys, places = (("quality", 200.0),), ((60.0, 30.0),)
    rig = VirtualRig(
        VirtualSettings(plate="thin", plate_keys=keys, outline=Outline.rectangle(250.0, 150.0), actuator_mm=places)
    )
    short, long = rig.truth(-40.0, 10.0, 1000)[0], rig.truth(-40.0, 10.0, 50_000)[0, :1000]
    assert np.linalg.norm(short - long) < 2e-3 * np.linalg.norm(long)


# --- the elastic solid


LOSSY_DISK = Outline.of("disk", 90.0, 90.0)
SOLID_KEYS = {"shear_speed_m_s": 5.0, "pressure_speed_m_s": 8.0, "damping_per_s": 2500.0}
"""So lossy that nothing comes back from the rim of the disk."""
SOLID_SOURCE_MM = np.array([[4.0, -3.0]])
SOLID_PLACE_MM = np.array([[-12.0, 9.0], [3.0, 21.0], [14.0, -3.0], [-2.0, -17.0], [5.5, -1.5]])


def _solid_solved(elements, frequency_hz):
    """Velocity (places, oscillation, force) from the weak form of the paper's eq. (3) in units of rho c_s^2."""
    import skfem

    def gradients(of_u, of_v):
        return skfem.BilinearForm(lambda u, v, _: u.grad[of_u] * v.grad[of_v]).assemble(elements.basis)

    angular, shear, pressure = 2 * np.pi * frequency_hz, SOLID_KEYS["shear_speed_m_s"], SOLID_KEYS["pressure_speed_m_s"]
    modulus = 1 / (1 - 1j * SOLID_KEYS["damping_per_s"] / angular)
    lame, mass = ((pressure / shear) ** 2 - 2) * modulus, (angular / shear) ** 2 * elements.mass
    xx, yy, xy, yx = gradients(0, 0), gradients(1, 1), gradients(1, 0), gradients(0, 1)
    system = block_array(
        [
            [(lame + 2 * modulus) * xx + modulus * yy - mass, lame * xy + modulus * yx],
            [lame * yx + modulus * xy, (lame + 2 * modulus) * yy + modulus * xx - mass],
        ]
    ).tocsc()
    load, count = elements.forces(SOLID_SOURCE_MM)[:, 0], elements.mass.shape[0]
    forces = np.zeros((2 * count, 2), dtype=np.complex128)
    forces[:count, 0] = forces[count:, 1] = load
    # Symmetric, which an ordering for it halves the fill of.
    factors = splu(system, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    moved = factors.solve(forces)
    parts = [elements.values_at(SOLID_PLACE_MM, np.asarray(part)) for part in (moved[:count], moved[count:])]
    return 1j * angular * np.stack(parts, axis=1)


@pytest.mark.parametrize(
    "frequency_hz", [pytest.param(60.0, marks=pytest.mark.nightly), pytest.param(450.0, marks=pytest.mark.long)]
)
def test_given_a_lossy_solid_then_the_tensor_is_that_of_finite_elements(frequency_hz):
    elements = Elements(triangulate(LOSSY_DISK, 0.5 * spacing_mm(DampedWave(5.0, 2500.0), 450.0)))
    solved = _solid_solved(elements, frequency_hz)
    for force in (0, 1):
        for oscillation in (0, 1):
            directions = {"force_deg": 90.0 * force, "oscillation_deg": 90.0 * oscillation}
            plate = SolidPlate(SOLID_SOURCE_MM, LOSSY_DISK, np.ones_like, **SOLID_KEYS, **directions)
            found = [plate.response(tuple(place), frequency_hz, 2, single=False)[0, 1] for place in SOLID_PLACE_MM]
            wanted = solved[:, oscillation, force]
            assert np.linalg.norm(found - wanted) < 0.01 * np.linalg.norm(wanted), (force, oscillation)
