"""The doctor through the real command: findings for people and programs, and exit codes."""

import json

import pytest

from tests.lab_files import ABSENT_RIG
from wavefocus.__main__ import run

RIG = """
[actuators]
position_mm = [[110, 0], [0, 60], [-110, 10]]
"""
KEYS = {"rig", "name", "good", "counts", "findings", "versions"}


def doctor(rig, *options, capsys):
    capsys.readouterr()
    code = run(["doctor", str(rig), *options])
    told = capsys.readouterr()
    if "--json" in options:
        return code, json.loads(told.out), told.err
    return code, {}, told.out + told.err


def written(folder, text):
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    return folder / "rig.toml"


def test_given_a_sound_rig_then_exit_0_and_one_object(tmp_path, capsys):
    code, told, _ = doctor(written(tmp_path, RIG), "--json", capsys=capsys)
    assert code == 0
    assert set(told) == KEYS
    assert told["good"] is True
    assert told["counts"]["fail"] == 0
    checks = {(one["instrument"], one["check"]) for one in told["findings"]}
    assert {
        ("mirror", "corners"),
        ("player", "clock ratio"),
        ("vibrometer", "response"),
        ("disk", "free space"),
    } <= checks
    assert {"python", "numpy", "pyserial", "nidaqmx", "sounddevice"} <= set(told["versions"])


def test_given_people_then_they_get_a_table_on_standard_output(tmp_path, capsys):
    folder = tmp_path / "lab [red]"
    folder.mkdir()
    code, told, people = doctor(written(folder, RIG), "--no-play", capsys=capsys)
    assert (code, told) == (0, {})
    assert "[red]" in people.replace("\n", "")
    for word in ("instrument", "mirror", "corners", "skipped", "nothing was to be played", "findings"):
        assert word in people


@pytest.mark.parametrize(
    ("flaw", "failing"),
    [
        ("noise_v = 0.5", "response"),
        ("output_gain_spread_db = 20\nseed = 6", "loopback level"),
        ("dead_actuators = [0, 1, 2]", "response"),
        ("dead_actuators = [1]", "actuator"),
    ],
)
def test_given_something_not_good_enough_then_exit_1_and_what_to_do(tmp_path, capsys, flaw, failing):
    code, told, people = doctor(written(tmp_path, f"{RIG}[emulation]\n{flaw}\n"), "--json", capsys=capsys)
    assert code == 1
    assert told["good"] is False
    bad = [one for one in told["findings"] if one["verdict"] == "fail"]
    assert [one["check"] for one in bad] == [failing]
    assert all(one["remedy"] for one in bad)
    assert "1 not good enough" in people


def test_real_instruments_that_are_not_there_then_each_is_a_finding_with_what_to_do(tmp_path, capsys):
    code, told, _ = doctor(written(tmp_path, ABSENT_RIG.format(folder=tmp_path)), "--json", capsys=capsys)
    assert code == 1
    bad = {one["instrument"]: one for one in told["findings"] if one["verdict"] == "fail"}
    assert set(bad) == {"mirror", "recorder", "player"}
    for one in bad.values():
        assert one["check"] == "opening"
        assert one["remedy"]
    assert {one["instrument"] for one in told["findings"] if one["verdict"] == "skipped"} >= {"mirror", "player"}


def test_given_a_usb_device_that_is_not_plugged_in_then_it_is_missed(tmp_path, capsys):
    usb = '[[usb]]\nrole = "recorder"\nvendor_id = 0x3923\nproduct_id = 0x7179\nserial_number = "none has this"\n'
    code, told, _ = doctor(written(tmp_path, RIG + usb), "--json", "--no-play", capsys=capsys)
    assert code == 1
    (bad,) = [one for one in told["findings"] if one["verdict"] == "fail"]
    assert bad["instrument"] == "usb"
    assert bad["remedy"]


def test_reset_of_device_that_rig_does_not_expect_then_exit_2_and_what_it_expects(tmp_path, capsys):
    assert run(["init", str(tmp_path / "lab")]) == 0
    capsys.readouterr()
    assert run(["doctor", str(tmp_path / "lab" / "rig.toml"), "--reset-usb", "recorder"]) == 2
    assert "[[usb]]" in capsys.readouterr().err


def test_given_a_reset_of_a_device_that_is_not_plugged_in_then_exit_3_and_what_to_do(tmp_path, capsys):
    rig = tmp_path / "rig.toml"
    rig.write_text('[[usb]]\nrole = "recorder"\nvendor_id = 0x3923\nproduct_id = 0x7179\n', encoding="utf-8")
    assert run(["doctor", str(rig), "--reset-usb", "recorder"]) == 3
    error = capsys.readouterr().err
    assert "recorder" in error
    assert error.count("\n") == 1


def test_given_a_wrong_rig_file_then_exit_2_and_one_line(tmp_path, capsys):
    code, _, people = doctor(written(tmp_path, "[mirror]\nlimit_deg = 3\n"), capsys=capsys)
    assert code == 2
    assert people.count("\n") == 1
    assert "mirror.limit_deg = 3: unknown key" in people
