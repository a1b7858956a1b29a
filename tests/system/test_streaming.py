"""Scenes that are rendered into files, and played from them, through the command line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import soundfile

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
def lab(tmp_path: Path) -> Path:
    x_mm, y_mm = np.meshgrid(np.arange(5) * 4.0, np.arange(3) * 4.0)
    green = np.random.default_rng(4).standard_normal((15, 3, 60)) * np.exp(-np.arange(60) / 15)
    with h5py.File(tmp_path / "bank.h5", "w") as file:
        file["green"], file["position_mm"] = green, np.column_stack([x_mm.ravel(), y_mm.ravel()])
        file.attrs["sample_rate_hz"] = 2000.0
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    (tmp_path / "rig.toml").write_text(RIG, encoding="utf-8")
    return tmp_path


def render(lab: Path, name: str, *options: str) -> int:
    out, wav = str(lab / f"{name}.h5"), str(lab / f"{name}.wav")
    place = [str(lab / "scene.toml"), "--bank", str(lab / "bank.h5"), "--rig", str(lab / "rig.toml")]
    return run(["render", *place, "--out", out, "--wav", wav, "--json", *options])


def test_the_wav_of_a_scene_that_is_too_loud_reaches_full_scale_and_not_more(
    lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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


def play(lab: Path, what: str, *options: str) -> int:
    return run(["play", str(lab / what), "--rig", str(lab / "rig.toml"), "--json", *options])


def test_given_a_scene_and_a_bank_then_it_is_played_within_limits(
    lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert play(lab, "scene.toml", "--bank", str(lab / "bank.h5")) == 0
    told = capsys.readouterr()
    figures: dict[str, Any] = json.loads(told.out)
    assert figures["peak_v"] <= 0.01
    assert figures["ahead_ms"] == 2000.0
    assert "muted" in told.err


@pytest.mark.parametrize(
    ("what", "options", "told"),
    [
        ("scene.toml", (), "--bank"),
        ("drive.h5", ("--bank", "bank.h5"), "leave out --bank"),
        ("scene.toml", ("--bank", "bank.h5", "--loop", "2"), "--loop"),
        ("scene.toml", ("--bank", "bank.h5", "--ahead-s", "1"), "--ahead-s is gone: 2 s"),
    ],
)
def test_given_options_that_do_not_go_together_then_the_line_says_what_to_do(
    lab: Path, capsys: pytest.CaptureFixture[str], what: str, options: tuple[str, ...], told: str
) -> None:
    assert play(lab, what, *options) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "told"), [(("--device", "cuda", "--tolerance-db", "-60"), "--device c"), (("--stream",), "is gone")]
)
def test_given_what_a_gpu_does_not_know_or_what_is_gone_then_it_is_refused(
    lab: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], told: str
) -> None:
    assert render(lab, "drive", *options) == 2
    assert told in capsys.readouterr().err
