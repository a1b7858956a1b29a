"""A bank written by a few lines of h5py: what it renders and predicts, and what cannot be done with it."""

import h5py
import numpy as np
import pytest

from tests.lab_files import stroke_scene, write_foreign
from tests.system.captures import answered, refused, said_by, wavefocus
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import load_scene

RATE_HZ, TAPS, ACTUATORS = 2000.0, 60, 3


def scene_of(emission):
    keys = f'start_s = 0.01\namplitude = 0.5\nemission = "{emission}"'
    sine = 'kind = "sine", frequency_hz = 150.0, duration_s = 0.03'
    return stroke_scene([0, 0], [12, 4], sine, keys, "[regularisation]\nsaturation = 0.7", speed_mm_s=200.0)


@pytest.fixture
def bank(tmp_path):
    (tmp_path / "scene.toml").write_text(scene_of("per_point"), encoding="utf-8")
    return write_foreign(tmp_path / "foreign.h5")


@pytest.mark.parametrize("emission", ["per_point", "continuous"])
def test_given_a_bank_of_ten_lines_then_drive_and_field_are_those_of_its_arrays(bank, tmp_path, emission, capsys):
    """Those of arrays are held against the equations in tests/unit/test_drive.py and test_path_figures.py."""
    scene, drive_file, field_file = tmp_path / "scene.toml", tmp_path / "drive.h5", tmp_path / "field.h5"
    scene.write_text(scene_of(emission), encoding="utf-8")
    told = answered(capsys, "render", scene, "--bank", bank, "--out", drive_file)
    assert told["method"] == ("sampled" if emission == "per_point" else "exact")
    assert told["omitted_bound"] == 0.0
    assert wavefocus("predict", drive_file, "--bank", bank, "--out", field_file) == 0
    with h5py.File(bank, "r") as file:
        green, position_mm = file["green"][:], file["position_mm"][:]
    expected = render_with_report(load_scene(scene), GreenArray(green, position_mm, RATE_HZ))[0].drive_v
    with h5py.File(drive_file, "r") as file:
        assert file["drive"].dtype == np.float64
        assert file["drive"].shape == expected.shape
        np.testing.assert_allclose(file["drive"][:], expected, rtol=0, atol=1e-9 * np.abs(expected).max())
        assert file.attrs["start_s"] == pytest.approx(-(TAPS - 1) / RATE_HZ)
        drive = file["drive"][:]
    field = np.array([sum(np.convolve(drive[i], green[row, i]) for i in range(ACTUATORS)) for row in range(len(green))])
    with h5py.File(field_file, "r") as file:
        assert file["field"].shape == field.shape
        # The contract's file is float32: the float64 result, rounded once.
        np.testing.assert_allclose(file["field"][:], field, rtol=0, atol=1e-7 * np.abs(field).max())
        assert list(file["position_index"]) == list(range(15))


def test_given_a_bank_without_a_plan_then_it_cannot_be_measured_on(bank, tmp_path, capsys):
    before = bank.read_bytes()
    verify = ["verify", tmp_path / "scene.toml", "--rig", "virtual", "--out", tmp_path / "out", "--bank"]
    for command in (["resume"], ["remeasure", "--positions", "1"], verify):
        told = refused(capsys, *command, bank)
        assert "foreign.h5" in told
        assert "made by other means" in told
        assert bank.read_bytes() == before


def test_a_changed_drive_is_refused_and_one_without_checksums_is_unverified(tmp_path, bank, capsys):
    drive = tmp_path / "drive.h5"
    predict = ["predict", drive, "--bank", bank, "--out", tmp_path / "field.h5"]
    assert wavefocus("render", tmp_path / "scene.toml", "--bank", bank, "--out", drive) == 0
    with h5py.File(drive, "r+") as file:
        file["drive"][0, 5] += 1e-9
    for command in (predict, ["check", drive]):
        assert "drive.h5" in refused(capsys, *command)
    with h5py.File(drive, "r+") as file:
        del file.attrs["contents_sha256"]
        for name in ("time_s", "drive", "focus/sample", "focus/position", "focus/source", "actuator"):
            del file[name].attrs["sha256"]
    assert "unverified" in said_by(capsys, *predict).err
