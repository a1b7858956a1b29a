"""Drives played on the virtual rig through the command line, and what is refused before anything sounds."""

import json

import numpy as np
import pytest

from wavefocus.__main__ import run
from wavefocus.storage.drive_file import Drive, write_drive

RATE_HZ = 10_000.0
RIG = """
[actuators]
position_mm = [[110.0, 0.0], [0.0, 60.0], [-110.0, 10.0]]

[player]
limit_v = 2.0
coil_resistance_ohm = 8.0
limit_power_w = 0.04
"""


@pytest.fixture
def lab(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG, encoding="utf-8")
    write(tmp_path, 0.5)
    return tmp_path


def write(lab, amplitude_v, actuators=3, seconds=1.5):
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    drive_v = np.zeros((actuators, time_s.size))
    drive_v[1] = amplitude_v * np.sin(2 * np.pi * 100.0 * time_s)
    none = np.zeros(0, np.int64)
    write_drive(lab / "drive.h5", Drive(drive_v, RATE_HZ, -0.1999, "sampled", 1.0, 0.0, none, none, none), force=True)


def play(lab, *options):
    return run(["play", str(lab / "drive.h5"), "--rig", str(lab / "rig.toml"), "--json", *options])


def test_given_a_drive_then_it_is_played_and_told(lab, capsys):
    assert play(lab, "--loop", "3", "--gain-db", "-6.0206") == 0
    told = capsys.readouterr()
    figures = json.loads(told.out)
    assert (figures["seconds"], figures["loops"]) == (4.5, 3)
    assert figures["peak_v"] == pytest.approx(0.25, rel=1e-5)
    assert "muted" in told.err


def refused(lab, capsys, *options):
    assert play(lab, *options) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
    return told.err


def test_given_more_than_an_actuator_may_get_then_the_gain_that_would_do_does(lab, capsys):
    write(lab, 4.0)
    told = refused(lab, capsys, "--gain-db", "1")
    assert "actuator 1" in told
    assert "player.limit_v" in told
    assert play(lab, "--gain-db", "-6.03") == 2  # that is within 2 V, and the coil's power counts next
    told = capsys.readouterr().err
    assert "player.limit_power_w" in told
    assert "V rms" in told
    gain_db = told.split("--gain-db ")[1].split(",")[0]
    assert play(lab, "--gain-db", gain_db) == 0
    assert 20 * np.log10(4.0 / 2**0.5 / 0.32**0.5) == pytest.approx(-float(gain_db), abs=0.011)


def test_given_a_loop_then_the_power_counts_across_its_seam(lab, capsys):
    time_s = np.arange(15_000) / RATE_HZ
    drive_v = 0.9 * np.sin(2 * np.pi * 100.0 * time_s)
    drive_v[3_000:12_000] = 0.0  # loud at both ends: 0.3 s of each within a second, and 0.6 s where they meet
    none = np.zeros(0, np.int64)
    drive = Drive(np.tile(drive_v, (3, 1)), RATE_HZ, 0.0, "sampled", 1.0, 0.0, none, none, none)
    write_drive(lab / "drive.h5", drive, force=True)
    replaced(lab, "0.04", "0.02")
    assert play(lab) == 0
    assert "V rms" in (capsys.readouterr().err + refused(lab, capsys, "--loop", "2"))


def replaced(lab, old, new):
    text = (lab / "rig.toml").read_text(encoding="utf-8")
    (lab / "rig.toml").write_text(text.replace(old, new), encoding="utf-8")


@pytest.mark.parametrize(
    ("options", "change", "named"),
    [
        (("--gain-db", "400"), lambda lab: None, "--gain-db"),
        (("--loop", "0"), lambda lab: None, "--loop"),
        ((), lambda lab: write(lab, 0.1, actuators=4), "for 4 actuators"),
        ((), lambda lab: replaced(lab, "coil_resistance_ohm = 8.0", ""), "player.coil_resistance_ohm"),
    ],
    ids=["gain", "loop", "another rig", "power without a resistance"],
)
def test_given_what_cannot_be_played_then_one_sentence_names_it(lab, capsys, options, change, named):
    change(lab)
    assert named in refused(lab, capsys, *options)


def test_given_a_sweep_beyond_the_coils_power_then_the_run_is_refused(lab, capsys):
    (lab / "run.toml").write_text('rig = "rig.toml"\n\n[sweep]\namplitude_v = 1.0\n', encoding="utf-8")
    assert run(["plan", str(lab / "run.toml")]) == 2
    told = capsys.readouterr().err
    assert "sweep.amplitude_v" in told
    assert "player.limit_power_w" in told
