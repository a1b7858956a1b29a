"""Scenes that are rendered into files of drives and sounds through the command line."""

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile

from tests.lab_files import write_foreign
from wavefocus.__main__ import run
from wavefocus.storage.drive_file import read_drive

SCENE = """
[[source]]
speed_mm_s = 20.0
step_mm = 2.0
path = { kind = "line", start_mm = [0.5, 0], end_mm = [12, 4] }
signal = { kind = "noise", band_hz = [50, 900], duration_s = 1.0 }

[[source]]
start_s = 0.2
path = { kind = "point", at_mm = [4, 8] }
signal = { kind = "sine", frequency_hz = 800.0, duration_s = 0.5 }

[output]
interpolation = "nearest"
"""
RIG = """
[actuators]
position_mm = [[110.0, 0.0], [0.0, 60.0], [-110.0, 10.0]]

[player]
interface_rate_hz = 48000
full_scale_v = 0.01
limit_v = 0.01
"""


@pytest.fixture
def lab(tmp_path):
    write_foreign(tmp_path / "bank.h5")
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    (tmp_path / "rig.toml").write_text(RIG, encoding="utf-8")
    return tmp_path


def render(lab: Path, name: str, *options: str) -> int:
    out, wav = str(lab / f"{name}.h5"), str(lab / f"{name}.wav")
    place = [str(lab / "scene.toml"), "--bank", str(lab / "bank.h5"), "--rig", str(lab / "rig.toml")]
    return run(["render", *place, "--out", out, "--wav", wav, "--json", *options])


def test_the_wav_of_a_scene_that_is_too_loud_reaches_full_scale_and_not_more(lab, capsys):
    """A waveform is larger between the samples of its drive than at them: both are kept within full scale."""
    assert render(lab, "drive") == 0
    told = capsys.readouterr()
    heard, rate_hz = soundfile.read(lab / "drive.wav")
    assert rate_hz == 48_000
    assert np.abs(heard).max() == pytest.approx(1.0, abs=1e-6)
    drive = read_drive(lab / "drive.h5")
    assert np.abs(drive.drive_v).max() <= 0.01
    figures = json.loads(told.out)
    assert figures["peak_v"] == pytest.approx(np.abs(drive.drive_v).max(), rel=1e-9)
    assert "between samples" in figures["limited_by"]
    assert figures["scale"] == drive.scale < 1
    assert "between samples = 0.01 V; actuator" in told.err
