"""Plates by their formulas: as the paper measured, in warmth, under a finger, and by the names of files."""

import json
from inspect import signature
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu
from scipy.special import hankel2

from tests.unit.independent_plates import impulse_travel
from wavefocus.config.emulation import PlateKeys
from wavefocus.config.loading import validated
from wavefocus.config.outline import Outline
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import RunConfig, Virtual
from wavefocus.configuration import configuration_from_json
from wavefocus.mocks.plates import PLATES
from wavefocus.mocks.plates.infinite import PlateTable
from wavefocus.mocks.plates.making import DISK_MM, DISK_WEIGHTS, make_plate
from wavefocus.mocks.plates.soft import SOFT_PLATE, UNIT_FORCE_N, DampedWave, mean_hankel
from wavefocus.mocks.plates.stadium import Elements, spacing_mm, triangulate
from wavefocus.mocks.virtual.settings import MirrorGeometry, VirtualSettings
from wavefocus.mocks.virtual.synthesis import SignalStore, Spot, Synthesis, VirtualPlay, chain_response
from wavefocus.rig.instruments import openers_of
from wavefocus.rig.virtual_bench import virtual_settings
from wavefocus.storage.errors import InputError

STEP_HZ = 5.0
FREQUENCY_HZ = STEP_HZ * np.arange(1001)
TABLE = PlateTable(SOFT_PLATE, STEP_HZ, 1001, np.ones(1001, dtype=np.complex128))


def test_on_the_soft_plate_an_impulse_travels_as_the_paper_measured():
    """Group velocity and attenuation of band-limited impulses, section IV.A."""
    travel = impulse_travel(SOFT_PLATE, (50.0, 450.0))
    assert travel.group_velocity_m_s == pytest.approx(4.8, rel=1e-6)
    assert travel.attenuation_db_per_cm == pytest.approx(3.8, rel=1e-6)


@pytest.mark.parametrize("radius_mm", [0.0, 1.0, 2.4, 2.6, 8.0])
def test_given_any_distance_then_the_mean_is_that_of_the_disc(radius_mm):
    k = SOFT_PLATE.wavenumber(250.0)
    # Quadrature over the disc in polar coordinates about the observer, where r dr tames the logarithm.
    angle = (np.arange(20_000) + 0.5) * 2 * np.pi / 20_000
    a = 2.5
    root = np.sqrt(np.maximum(a**2 - (radius_mm * np.sin(angle)) ** 2, 0.0))
    hit = (np.abs(radius_mm * np.sin(angle)) < a) & (radius_mm * np.cos(angle) + root > 0)
    near = np.maximum(radius_mm * np.cos(angle) - root, 0.0)[hit]
    far = (radius_mm * np.cos(angle) + root)[hit]
    integral = (_ring(k, far) - _ring(k, near)).sum() * 2 * np.pi / 20_000
    expected = integral / (np.pi * (a / 1e3) ** 2)
    assert mean_hankel(k, radius_mm / 1e3, a / 1e3) == pytest.approx(expected, rel=2e-4)


def _ring(k, s_mm):
    """Integral of H0(2)(k s) s from 0 to s."""
    z = k * np.maximum(s_mm, 1e-9) / 1e3
    return (z * hankel2(1, z) - 2j / np.pi) / k**2


@given(st.floats(0.0, 400.0))
def test_given_any_distance_then_the_table_is_within_1e_minus_7(radius_mm):
    direct = SOFT_PLATE.velocity(FREQUENCY_HZ[1:], radius_mm)
    error = TABLE.evaluate(np.array([radius_mm]))[0, 1:] - direct
    assert np.max(np.abs(error) / np.abs(direct)) < 1e-8


@given(st.floats(-120, 120), st.floats(-70, 70), st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6))
def test_given_any_mirror_then_its_angles_lead_back_to_the_spot(x_mm, y_mm, bent):
    a, b, c, d, e, f = bent
    mirror = MirrorGeometry(((1 + a, b, 12.0), (c, 1 + d, -7.0), (e, f, 900.0)))
    assert mirror.spot_mm(*mirror.angles_mrad(x_mm, y_mm)) == pytest.approx((x_mm, y_mm), abs=1e-9)


def test_files_name_the_registered_plates_and_only_their_keys():
    assert set(get_args(PlateKeys.model_fields["plate"].annotation)) == set(PLATES.all())
    without_effect = ("loss", "edge", "mode_tolerance")
    for key, field in PlateKeys.model_fields.items():
        if isinstance(field.json_schema_extra, dict) and key not in without_effect:
            assert key in signature(PLATES.all()[field.json_schema_extra["plate"]].__init__).parameters


@pytest.mark.parametrize(("plate", "key", "value"), [("soft", "loss", "springpot"), ("thin", "edge", "infinite")])
def test_a_plate_of_earlier_versions_is_refused_in_files_and_read_in_banks_alone(plate, key, value):
    sentence, table = f'{key} = "{value}": is gone: ', {"plate": plate, key: value}
    for model, name in ((RunConfig, "virtual"), (RigConfig, "emulation")):
        with pytest.raises(InputError, match=f"a.toml: {name}.{sentence}"):
            validated(model, {name: table}, "a.toml")
    kept = configuration_from_json("{}", json.dumps({"virtual": table}), np.zeros((1, 2)), "b.h5")
    assert kept.run.virtual.plate == plate
    with pytest.raises(InputError, match=f"^{sentence}"):
        openers_of(kept.rig, kept.run.virtual)


# --- in warmth and under a finger


ACTUATOR_MM = np.array([[26.0, 0.0], [0.0, 13.0]])
STADIUM, RECTANGLE = Outline.stadium(70.0, 40.0), Outline.rectangle(70.0, 40.0)
FINGER = {"place_mm": (-5.0, 4.0), "mass_kg": 2e-4, "damping_n_s_m": 1.5, "stiffness_n_m": 800.0}
TOUCHED = [("soft", {}), ("solid", {"oscillation_deg": 50.0}), ("thin", {"quality": 20.0})]


def test_finger_on_stadium_then_its_field_is_that_of_elements_with_finger_on_them(tmp_path, monkeypatch):
    monkeypatch.setenv("WAVEFOCUS_CACHE", str(tmp_path))
    elements = Elements(triangulate(STADIUM, spacing_mm(SOFT_PLATE, 500.0)))
    plate = make_plate("stadium", ACTUATOR_MM, STADIUM, np.ones_like, {"finger": FINGER})
    load = csc_array(elements.forces(np.array([FINGER["place_mm"]])))
    force = elements.forces(ACTUATOR_MM).astype(complex)
    places = np.array([[12.0, -7.0], [-20.0, 8.0], [-5.0, 4.5]])
    responses = [plate.response(tuple(place), 50.0, 10, single=False) for place in places]
    for number in (2, 8):
        frequency_hz = 50.0 * number
        angular = 2j * np.pi * frequency_hz
        impedance = angular * FINGER["mass_kg"] + FINGER["damping_n_s_m"] + FINGER["stiffness_n_m"] / angular
        system = elements.stiffness - complex(SOFT_PLATE.wavenumber(frequency_hz)) ** 2 * elements.mass
        touched = system + angular * impedance / UNIT_FORCE_N * (load @ load.T)
        free, wanted = (
            angular * elements.values_at(places, splu(matrix.tocsc()).solve(force)) for matrix in (system, touched)
        )
        found = [response[:, number] for response in responses]
        assert np.linalg.norm(found - wanted) < 0.01 * np.linalg.norm(wanted)
        assert np.linalg.norm(free - wanted) > 0.05 * np.linalg.norm(wanted)


@pytest.mark.parametrize(("name", "keys"), TOUCHED)
def test_any_plate_then_a_hard_finger_holds_its_place_and_one_of_air_does_nothing(name, keys):
    def covered(damping):
        finger = {"finger": {"place_mm": (-5.0, 4.0), "mass_kg": 0.0, "damping_n_s_m": damping, "stiffness_n_m": 0.0}}
        touched = keys if damping is None else keys | finger
        plate = make_plate(name, ACTUATOR_MM, RECTANGLE, chain_response, touched)
        places = np.array([-5.0, 4.0]) + DISK_MM
        each = [plate.response(tuple(place), 100.0, 5, single=False)[:, 1:] for place in places]
        return np.tensordot(DISK_WEIGHTS, each, axes=1)

    np.testing.assert_allclose(covered(0.0), covered(None), rtol=1e-9)
    assert np.linalg.norm(covered(1e6)) < 1e-3 * np.linalg.norm(covered(None))


def test_warmer_soft_plate_then_its_waves_are_those_of_slower_medium_that_moves_more():
    keys = {"speed_per_k": -0.01, "loss_per_k": 0.03}
    plate = make_plate("soft", ACTUATOR_MM, RECTANGLE, chain_response, keys, 4.0)
    found = plate.response((12.0, -7.0), 50.0, 11, single=False)[:, 1:]
    slower = DampedWave(0.96 * SOFT_PLATE.speed_m_s, 1.12 * SOFT_PLATE.damping_per_s)
    hertz = 50.0 * np.arange(1, 11)
    distance_mm = np.hypot(*(ACTUATOR_MM - (12.0, -7.0)).T)[:, None]
    wanted = slower.velocity(hertz, distance_mm) * chain_response(hertz) / 0.96**2
    assert np.linalg.norm(found - wanted) < 1e-6 * np.linalg.norm(wanted)


def test_course_of_room_then_plate_follows_it_and_without_key_it_does_not():
    def recorded(keys, seconds):
        synthesis = Synthesis(VirtualSettings(plate_keys=keys, room_c=((0.0, 21.0), (100.0, 25.0))))
        start_ns, click = round(1e9 * seconds), SignalStore(5.0).find(np.ones(20))
        play = VirtualPlay(start_ns, 10_000.0, {0: click}, 20, 0.0)
        return synthesis.voltages(2000, 10_000.0, start_ns, [play], [Spot(0, 2000, (90.0, 10.0))])[1]

    following = (("speed_per_k", -0.01),)
    assert np.array_equal(recorded(following, 0.0), recorded((), 0.0))
    assert not np.array_equal(recorded(following, 0.0), recorded(following, 100.0))
    assert np.array_equal(recorded((), 0.0), recorded((), 100.0))


def test_the_plate_of_the_rig_file_is_emulated_unless_the_run_file_names_one():
    finger = {"place_mm": (0.0, 0.0), "mass_kg": 1e-4}
    rig = RigConfig.model_validate({"emulation": {"plate": "solid", "force_deg": 30.0, "finger": finger}})
    settings = virtual_settings(rig)
    assert (settings.plate, dict(settings.plate_keys)["force_deg"]) == ("solid", 30.0)
    assert virtual_settings(rig, Virtual(plate="stadium")).plate == "stadium"
    assert virtual_settings(rig, Virtual(seed=5)).plate == "solid"
    plain = RigConfig().emulation
    assert plain.is_flawless
    assert "plate" not in plain.plan_values()
    assert not rig.emulation.is_flawless
