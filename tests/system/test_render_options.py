"""What ``render`` and ``movie`` do besides drives: limits, figures, pictures."""

import json

import h5py
import numpy as np
import pytest
from PIL import Image

from tests.lab_files import write_foreign
from wavefocus.__main__ import run
from wavefocus.storage.drive_file import read_drive

RATE_HZ = 2000.0
SCENE = """
[scene]
name = "two"

[[source]]
speed_mm_s = 200.0
step_mm = 4.0
path = { kind = "line", start_mm = [0.5, 0], end_mm = [12, 4] }
signal = { kind = "sine", frequency_hz = 150.0, duration_s = 0.03 }
emission = "per_point"

[[source]]
start_s = 0.02
path = { kind = "point", at_mm = [4, 8] }
signal = { kind = "impulse" }

[regularisation]
saturation = 0.7
"""
RIG = """
[actuators]
position_mm = [[110.0, 0.0], [0.0, 60.0], [-110.0, 10.0]]

[player]
limit_v = 2.0
limit_rms_v = 1e-3
"""


@pytest.fixture
def lab(tmp_path):
    write_foreign(tmp_path / "bank.h5", gain=[[[1.0], [2.0], [8.0]]])
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    (tmp_path / "rig.toml").write_text(RIG, encoding="utf-8")
    return tmp_path


def render(lab, *options):
    place = [str(lab / "scene.toml"), "--bank", str(lab / "bank.h5"), "--out", str(lab / "drive.h5"), "--force"]
    return run(["render", *place, "--json", *options])


def figures(lab, capsys, *options):
    assert render(lab, *options) == 0
    return dict(json.loads(capsys.readouterr().out))


def test_limits_of_scene_and_rig_then_the_stricter_scales_and_the_actuator_is_named(lab, capsys):
    free_v = (figures(lab, capsys), read_drive(lab / "drive.h5").drive_v)[1]
    (lab / "scene.toml").write_text(SCENE + "\n[output]\nlimit_rms_v = 2e-3\n", encoding="utf-8")
    told = figures(lab, capsys)
    drive = read_drive(lab / "drive.h5")
    rms_v = np.sqrt(np.mean(drive.drive_v**2, axis=1))
    assert rms_v.max() == pytest.approx(2e-3, rel=1e-9)
    assert (told["limited_by"], told["limiting_actuator"]) == ("limit_rms_v", int(np.argmax(rms_v)))
    assert np.allclose(drive.drive_v, drive.scale * free_v, rtol=1e-12, atol=0)
    told = figures(lab, capsys, "--rig", str(lab / "rig.toml"))
    rms_v = np.sqrt(np.mean(read_drive(lab / "drive.h5").drive_v ** 2, axis=1))
    assert rms_v.max() == pytest.approx(1e-3, rel=1e-9)
    assert told["scale"] == pytest.approx(drive.scale / 2, rel=1e-9)


def test_given_a_field_then_the_movie_command_draws_it(lab, capsys):
    told = figures(lab, capsys)
    bank = ["--bank", str(lab / "bank.h5")]
    assert run(["predict", str(lab / "drive.h5"), *bank, "--out", str(lab / "field.h5")]) == 0
    draw = ["movie", str(lab / "field.h5"), *bank, "--drive", str(lab / "drive.h5"), "--json"]
    files = ["--out", str(lab / "field.gif"), "--snapshots", str(lab / "foci.png")]
    assert run([*draw, *files, "--slow", "5"]) == 0
    told = json.loads(capsys.readouterr().out)
    with Image.open(lab / "field.gif") as gif, Image.open(lab / "foci.png") as picture:
        assert gif.n_frames == told["frames"] > 5
        assert gif.width == 720
        assert picture.width > 1000
    assert told["slowed"] == pytest.approx(5.0)


def test_given_a_field_at_a_lower_rate_then_the_movie_tells_which_waves_it_shows(lab, capsys):
    figures(lab, capsys)
    bank = ["--bank", str(lab / "bank.h5")]
    assert run(["predict", str(lab / "drive.h5"), *bank, "--out", str(lab / "low.h5"), "--rate", str(RATE_HZ / 2)]) == 0
    draw = ["--out", str(lab / "low.gif"), "--from-s", "0", "--to-s", "0.01"]
    assert run(["movie", str(lab / "low.h5"), *bank, *draw]) == 0
    told = capsys.readouterr().err
    assert f"predicted at {RATE_HZ / 2:g} Hz: it shows waves up to {0.2 * RATE_HZ:g} Hz alone" in told


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ((), "--out"),
        (("--snapshots", "foci.png"), "--drive"),
        (("--out", "nowhere/field.gif"), "there is no folder"),
        (("--out", "field.gif", "--from-s", "9"), "nothing to show"),
    ],
)
def test_given_a_movie_that_cannot_be_then_one_sentence_says_why(lab, capsys, monkeypatch, options, named):
    monkeypatch.chdir(lab)
    assert render(lab) == 0
    assert run(["predict", "drive.h5", "--bank", "bank.h5", "--out", "field.h5"]) == 0
    assert run(["movie", "field.h5", "--bank", "bank.h5", *options]) == 2
    assert named in capsys.readouterr().err.splitlines()[-1]
    assert not list(lab.glob("*.gif"))


POINT = """
[[source]]
amplitude = {amplitude}
path = {{ kind = "point", at_mm = [4, 8] }}
signal = {signal}

[regularisation]
normalise = true

[output]
{limit}
"""


def write_point(lab, signal, amplitude, limit=""):
    text = POINT.format(signal=signal, amplitude=amplitude, limit=limit)
    (lab / "scene.toml").write_text(text, encoding="utf-8")


@pytest.mark.parametrize(
    "signal", ['{ kind = "impulse" }', '{ kind = "sine", frequency_hz = 150.0, duration_s = 0.1 }']
)
@pytest.mark.parametrize("limit", ["", "limit_v = 1e-4"], ids=["unlimited", "limited"])
def test_given_a_focus_then_its_reported_peak_is_what_predict_finds_there(lab, capsys, signal, limit):
    write_point(lab, signal, 0.001, limit)
    found = figures(lab, capsys)
    row = 5 * 2 + 1  # (4, 8) mm
    drive, bank, field = (str(lab / name) for name in ("drive.h5", "bank.h5", "field.h5"))
    assert run(["predict", drive, "--bank", bank, "--out", field, "--positions", str(row)]) == 0
    with h5py.File(field) as file:
        assert found["focus_peak"] == pytest.approx(np.abs(file["field"][:]).max(), rel=1e-5)
    assert found["response_unit"] == "m/s"
