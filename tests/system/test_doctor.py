"""The doctor through the real command: findings for people and programs, and exit codes."""

import json

import pytest

from tests.lab_files import ABSENT_RIG, RIG
from tests.system.captures import refused
from wavefocus.__main__ import run

USB = '[[usb]]\nrole = "recorder"\nvendor_id = 0x3923\nproduct_id = 0x7179\nserial_number = "none has this"\n'


@pytest.fixture
def doctor(tmp_path, capsys):
    """Examine a rig of this text: exit code, standard output and standard error."""

    def examined(text, *options):
        folder = tmp_path / "lab [red]"
        folder.mkdir()
        (folder / "rig.toml").write_text(text.replace("{folder}", str(folder)), encoding="utf-8")
        code = run(["doctor", str(folder / "rig.toml"), *options])
        return code, *capsys.readouterr()

    return examined


def test_given_people_then_they_get_a_table_on_standard_output(doctor):
    code, out, _ = doctor(RIG, "--no-play")
    assert code == 0
    assert "[red]" in out.replace("\n", "")
    for word in ("instrument", "mirror", "corners", "skipped", "nothing was to be played", "findings"):
        assert word in out


def test_given_something_not_good_enough_then_exit_1_and_one_object_with_what_to_do(doctor):
    code, out, people = doctor(f"{RIG}[emulation]\ndead_actuators = [1]\n", "--json")
    told = json.loads(out)
    bad = [one for one in told["findings"] if one["verdict"] == "fail"]
    assert (code, told["good"], [one["check"] for one in bad]) == (1, False, ["actuator"])
    assert told["counts"]["fail"] == 1
    assert all(one["remedy"] for one in bad)
    assert "1 not good enough" in people
    assert set(told) == {"rig", "name", "good", "counts", "findings", "versions"}
    checks = {f"{one['instrument']}: {one['check']}" for one in told["findings"]}
    assert {"mirror: corners", "player: clock ratio", "vibrometer: response", "disk: free space"} <= checks
    assert {"python", "numpy", "pyserial", "nidaqmx", "sounddevice"} <= set(told["versions"])


def test_real_instruments_that_are_not_there_then_each_is_a_finding_with_what_to_do(doctor):
    code, out, _ = doctor(ABSENT_RIG + USB, "--json")
    findings = json.loads(out)["findings"]
    bad = {one["instrument"]: one for one in findings if one["verdict"] == "fail"}
    assert code == 1
    assert set(bad) == {"mirror", "recorder", "player", "usb"}
    assert all(one["check"] == "opening" for name, one in bad.items() if name != "usb")
    assert all(one["remedy"] for one in bad.values())
    assert {one["instrument"] for one in findings if one["verdict"] == "skipped"} >= {"mirror", "player"}


@pytest.mark.parametrize(
    ("text", "code", "words"),
    [(RIG, 2, "[[usb]]"), (USB, 3, "recorder"), ("[mirror]\nlimit_deg = 3\n", 2, "mirror.limit_deg = 3: unknown key")],
    ids=["a reset of a device that the rig does not expect", "of one that is not plugged in", "a wrong rig file"],
)
def test_given_what_cannot_be_done_then_one_line_says_so(tmp_path, capsys, text, code, words):
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    assert words in refused(capsys, "doctor", tmp_path / "rig.toml", "--reset-usb", "recorder", code=code)
