"""A bank written by a few lines of h5py renders and predicts as the contract's equations say."""

import h5py
import numpy as np
import pytest

from tests.lab_files import write_foreign
from tests.system.captures import answered, refused, wavefocus

RATE_HZ, TAPS, ACTUATORS = 2000.0, 60, 3

SCENE = """
[scene]
name = "stroke"

[[source]]
start_s = 0.01
speed_mm_s = 200.0
step_mm = 4.0
amplitude = 0.5
path = {{ kind = "line", start_mm = [0, 0], end_mm = [12, 4] }}
signal = {{ kind = "sine", frequency_hz = 150.0, duration_s = 0.03 }}
emission = "{emission}"

[regularisation]
saturation = 0.7
"""


@pytest.fixture
def bank(tmp_path):
    (tmp_path / "scene.toml").write_text(SCENE.format(emission="per_point"), encoding="utf-8")
    return write_foreign(tmp_path / "foreign.h5")


def _weights(green):
    """sigma (positions, actuators) and n (positions,) by equations 14 and 15."""
    rms = np.sqrt(np.mean(green**2, axis=2))
    limit = 0.7 * np.median(rms)
    sigma = np.where(rms < limit, 1.0, limit / rms)
    return sigma, 1.0 / np.sum(sigma * np.sum(green**2, axis=2), axis=1)


def _nearest(position_mm, point):
    return int(np.argmin(np.hypot(*(position_mm - point).T)))


def _direct_drive(green, position_mm, emission):
    """Equations 16 (per point) and 9 (continuous), sample by sample."""
    sigma, gain = _weights(green)
    u = 0.5 * np.sin(2 * np.pi * 150.0 * np.arange(60) / RATE_HZ)
    start, end = np.array([0.0, 0.0]), np.array([12.0, 4.0])
    length = float(np.hypot(12.0, 4.0))
    emissions: list[tuple[int, float, int]] = []
    points = int(length / 4.0 + 1e-9) + 1
    if emission == "per_point":
        for m in range(points):
            row = _nearest(position_mm, start + (end - start) * m * 4.0 / length)
            n_m = round((0.01 + m * 4.0 / 200.0) * RATE_HZ)
            emissions += [(n_m + s, u[s], row) for s in range(60)]
    else:
        first, last = round(0.01 * RATE_HZ), round((0.01 + points * 4.0 / 200.0) * RATE_HZ)
        for s in range(last - first):
            arc = min(200.0 * s / RATE_HZ, length)
            row = _nearest(position_mm, start + (end - start) * arc / length)
            emissions.append((first + s, u[s] if s < 60 else 0.0, row))
    drive = np.zeros((ACTUATORS, TAPS - 1 + max(n for n, _, _ in emissions) + 1))
    for n, value, row in emissions:
        for actuator in range(ACTUATORS):
            weight = value * gain[row] * sigma[row, actuator]
            drive[actuator, n : n + TAPS] += weight * green[row, actuator, ::-1]
    return drive


@pytest.mark.parametrize("emission", ["per_point", "continuous"])
def test_given_a_bank_of_ten_lines_then_drive_and_field_equal_the_equations(bank, tmp_path, emission, capsys):
    scene, drive_file, field_file = tmp_path / "scene.toml", tmp_path / "drive.h5", tmp_path / "field.h5"
    scene.write_text(SCENE.format(emission=emission), encoding="utf-8")
    told = answered(capsys, "render", scene, "--bank", bank, "--out", drive_file)
    assert told["method"] == ("sampled" if emission == "per_point" else "exact")
    assert told["omitted_bound"] == 0.0
    assert wavefocus("predict", drive_file, "--bank", bank, "--out", field_file) == 0
    with h5py.File(bank, "r") as file:
        green, position_mm = file["green"][:], file["position_mm"][:]
    expected = _direct_drive(green, position_mm, emission)
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
    capsys.readouterr()
    assert wavefocus(*predict) == 0
    assert "unverified" in capsys.readouterr().err
