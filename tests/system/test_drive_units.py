"""Units of drives: taken from the unit of the Green's functions, kept by exports, and played only in volts."""

import h5py
import numpy as np
import pytest
import pyuff

import wavefocus as wf
from tests.lab_files import point_scene, write_arrays
from tests.system.captures import refused, wavefocus
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.drive.wav import Interface
from wavefocus.storage.units import drive_of

POSITIONS, ACTUATORS, TAPS = 4, 2, 16
GREEN = (
    np.random.default_rng(3).standard_normal((POSITIONS, ACTUATORS, TAPS)) * np.exp(-np.arange(TAPS) / 1.5)
).astype(np.float32)
PLACES_MM = [[0.0, 0.0], [4.0, 0.0], [0.0, 4.0], [4.0, 4.0]]
RIG = "[actuators]\nposition_mm = [[0, 0], [9, 0]]\n"


def foreign(path, **attributes):
    return write_arrays(path, GREEN, PLACES_MM, **attributes)


@pytest.mark.parametrize(
    ("unit", "stated", "drive"),
    [
        ("m/s/N", "", "N"), ("m/s per mV", "", "mV"), ("m s-1 N-1", "", "N"), ("m/(s·A)", "", "A"),
        ("g/lbf", "", "lbf"),
        ("m·s⁻¹·V⁻¹", "", "V"), ("m/s/V^2", "", "V^2"), ("m/s/Vpp", "", "Vpp"), ("V/V", "volts", "V"),
        ("m/s", "", "V"), ("m/s", "N", "N"), ("um/m", "V", "V"),
        ("m/s/volt", "V", "V"), ("m/s per millivolt", "mV", "mV"),
    ],
)  # fmt: skip
def test_a_bank_then_takes_drives_in_the_unit_that_its_green_functions_name(tmp_path, unit, stated, drive):
    words = {"drive_unit": stated} if stated else {}
    with wf.open_bank(foreign(tmp_path / "b.h5", response_unit=unit, **words)) as bank:
        assert bank.drive_unit == drive == drive_of(unit, stated)


@pytest.mark.parametrize(("unit", "stated"), [("m/s/N", "V"), ("m/s per mV", "V"), ("m/s/V", "N"), ("g/V", "mV")])
def test_a_bank_that_names_two_drives_then_is_refused(tmp_path, capsys, unit, stated):
    told = refused(capsys, "status", foreign(tmp_path / "b.h5", response_unit=unit, drive_unit=stated))
    assert all(word in told for word in ("response_unit", unit, "drive_unit", stated))
    np.savez(tmp_path / "b.npz", green=GREEN, position_mm=np.zeros((POSITIONS, 2)), sample_rate_hz=2000.0,
             response_unit=unit, drive_unit=stated)  # fmt: skip
    refused(capsys, "import", tmp_path / "b.npz", "--bank", tmp_path / "i.h5")


@pytest.mark.parametrize("unit", ["m/s/N", "m/s per mV"])
def test_drives_that_are_not_in_volts_then_are_not_played(tmp_path, capsys, unit):
    bank, drive = foreign(tmp_path / "b.h5", response_unit=unit), tmp_path / "drive.h5"
    scene, rig = tmp_path / "scene.toml", tmp_path / "rig.toml"
    scene.write_text(point_scene([0, 0], 'kind = "impulse"'), encoding="utf-8")
    rig.write_text(RIG, encoding="utf-8")
    assert wavefocus("render", scene, "--bank", bank, "--out", drive) == 0
    assert wf.read_drive(drive).drive_unit == drive_of(unit)
    for command in (
        ["render", scene, "--bank", bank, "--out", tmp_path / "w.h5", "--wav", tmp_path / "w.wav"],
        ["play", drive, "--rig", rig],
        ["live", bank, "--rig", rig],
        ["predict", drive, "--bank", foreign(tmp_path / "volts.h5"), "--out", tmp_path / "field.h5"],
    ):
        assert f"in {drive_of(unit)}" in refused(capsys, *command)
    array = wf.GreenArray(GREEN, np.zeros((POSITIONS, 2)), 2000.0, response_unit=unit)
    assert wf.render(scene, array).drive_unit == drive_of(unit)


@pytest.mark.parametrize("key", ["limit_v", "limit_rms_v"])
@pytest.mark.parametrize(("unit", "size", "said"), [("m/s per mV", 1e-3, "V"), ("m/s/N", 1.0, "N")])
def test_a_limit_of_volts_then_is_one_also_for_drives_in_millivolt(tmp_path, key, unit, size, said):
    def limited(unit, most):
        scene = tmp_path / "scene.toml"
        scene.write_text(point_scene([0, 0], 'kind = "impulse"', "amplitude = 1e6", f"[output]\n{key} = {most}"))
        bank, outputs = wf.GreenArray(GREEN, PLACES_MM, 2000.0, response_unit=unit), Interface(4000, np.full(2, most))
        return render_with_report(wf.load_scene(scene), bank, interface=outputs)

    (drive, report), (volts, _) = limited(unit, 0.5), limited("m/s/V", 0.5 / size)
    np.testing.assert_allclose(drive.drive_v, volts.drive_v, rtol=1e-9)
    assert f" = 0.5 {said};" in str(report.limiting)


@pytest.mark.parametrize(
    ("unit", "over", "under", "codes"), [("m/s/V", "m/s", "V", (11, 0)), ("g/N", "g", "N", (0, 13))]
)
def test_a_universal_export_then_divides_by_the_drive_once(tmp_path, unit, over, under, codes):
    bank, out = foreign(tmp_path / "b.h5", response_unit=unit), tmp_path / "out.uff"
    assert wavefocus("export", bank, out, "--to", "uff") == 0
    found = next(one for one in pyuff.UFF(str(out)).read_sets() if one["type"] == 58)
    assert (found["ordinate_axis_units_lab"].strip(), found["orddenom_axis_units_lab"].strip()) == (over, under)
    assert (found["ordinate_spec_data_type"], found["orddenom_spec_data_type"]) == codes


def test_a_drive_and_a_bank_that_state_units_at_their_values_then_keep_them(tmp_path):
    path = foreign(tmp_path / "b.h5")
    with h5py.File(path, "r+") as file:
        file["green"].attrs["units"] = "Pa/N"
    with wf.open_bank(path) as bank:
        assert (bank.response_unit, bank.drive_unit) == ("Pa/N", "N")
    drive = tmp_path / "drive.h5"
    with h5py.File(drive, "w") as file:
        file["drive"] = np.zeros((ACTUATORS, 40))
        file["drive"].attrs["units"] = "N"
        file.attrs.update(format="wavefocus-drive", format_version=1, sample_rate_hz=2000.0, start_s=0.0)
    assert wf.read_drive(drive).drive_unit == "N"
    with h5py.File(drive, "r+") as file:
        file.attrs["drive_unit"] = "V"
    with pytest.raises(wf.InputError, match="both must agree"):
        wf.read_drive(drive)
