"""Numbers on the command line that no computation can do with: one sentence and exit code 2, or a result."""

import pytest

from tests.lab_files import point_scene, write_foreign
from tests.system.captures import wavefocus
from wavefocus.__main__ import run

EXTREMES = ("nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "-1e-320", "0", "1" + 5000 * "0")
RENDER = ["render", "scene.toml", "--bank", "bank.h5", "--out", "out.h5", "--force"]
PREDICT = ["predict", "drive.h5", "--bank", "bank.h5", "--out", "out.h5", "--force"]
MOVIE = ["movie", "field.h5", "--bank", "bank.h5", "--drive", "drive.h5", "--out", "out.gif", "--to-s", "0", "--force"]
CALIBRATE = ["calibrate", "rig.toml", "--only", "actuators"]
RESULT = (0, 1, 2)
OPTIONS = [
    (RENDER, "--tolerance-db", RESULT), (PREDICT, "--rate", RESULT), (MOVIE, "--from-s", RESULT),
    (MOVIE, "--slow", RESULT), (["play", "drive.h5", "--rig", "virtual"], "--gain-db", RESULT),
    # What these take within their bounds, a person at the bench would be asked for.
    (CALIBRATE, "--amplitude-v", (2,)), (CALIBRATE, "--limit-mm", (2,)), (CALIBRATE, "--summing-box", (2,)),
]  # fmt: skip


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    folder = tmp_path_factory.mktemp("numbers")
    write_foreign(folder / "bank.h5")
    assert wavefocus("init", folder) == 0
    scene = point_scene([4, 8], 'kind = "sine", frequency_hz = 150.0, duration_s = 0.02')
    (folder / "scene.toml").write_text(scene, encoding="utf-8")
    bank = ["--bank", folder / "bank.h5", "--out"]
    assert wavefocus("render", folder / "scene.toml", *bank, folder / "drive.h5") == 0
    assert wavefocus("predict", folder / "drive.h5", *bank, folder / "field.h5") == 0
    return folder


def told(lab, capsys, monkeypatch, command):
    monkeypatch.chdir(lab)
    capsys.readouterr()
    code = run(command)
    error = capsys.readouterr().err
    lines = [line for line in error.splitlines() if line.startswith("wavefocus:")]
    assert len(lines) == (code == 2), error
    # That is for defects, not for numbers.
    assert "cannot be computed" not in error
    return code


@pytest.mark.parametrize(("command", "option", "codes"), OPTIONS)
def test_given_an_extreme_number_then_a_result_or_one_sentence(lab, capsys, monkeypatch, command, option, codes):
    for text in EXTREMES:
        code = told(lab, capsys, monkeypatch, [*command, f"{option}={text}"])
        assert code in ((2,) if text in ("nan", "inf", "-inf") else codes)


def test_given_no_rows_or_rows_without_end_then_one_sentence(lab, capsys, monkeypatch):
    verify = ["verify", "scene.toml", "--bank", "bank.h5", "--rig", "virtual", "--out", "verify", "--positions"]
    for positions in (f"every:000000001{9 * 600}", "every:" + "9" * 5000, "0-" + "9" * 5000, ""):
        assert told(lab, capsys, monkeypatch, [*verify, positions]) == 2
