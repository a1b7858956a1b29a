"""Scenes of several and extended sources, and their sounds through the command line."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile

from tests.lab_files import write_foreign
from wavefocus.__main__ import run
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import load_scene
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


def render(lab, name, *options):
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


PAGE = Path(__file__).parents[2] / "docs/how-to/render-and-play.md"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    text = PAGE.read_text(encoding="utf-8").split("```toml\n")[1].split("```")[0]
    file = tmp_path_factory.mktemp("scene") / "scene.toml"
    file.write_text(text, encoding="utf-8")
    return load_scene(file)


@pytest.fixture(scope="module")
def bank():
    position_mm = np.array([(x, y) for y in np.arange(-12.0, 45.0, 4.0) for x in np.arange(-44.0, 45.0, 4.0)])
    green = np.random.default_rng(5).standard_normal((len(position_mm), 3, 80)) * np.exp(-np.arange(80) / 20)
    return GreenArray(green, position_mm, 2000.0)


def test_given_a_bar_then_its_points_move_abreast_and_say_the_same(scene, bank):
    bar = replace(scene, sources=scene.sources[:3])
    drive = render_with_report(bar, bank)[0]
    sample, place = drive.focus_sample.reshape(3, 21), bank.position_mm[drive.focus_position].reshape(3, 21, 2)
    assert (sample == sample[0]).all()
    assert (place[:, :, 0] == place[0, :, 0]).all()
    np.testing.assert_array_equal(np.diff(place[:, :, 1], axis=0), 8.0)
    signals = [source.signal.samples(2000.0) for source in bar.sources]
    np.testing.assert_array_equal(signals[0], signals[1])
    np.testing.assert_array_equal(signals[0], signals[2])
