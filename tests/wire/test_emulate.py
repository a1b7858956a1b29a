"""``wavefocus emulate``: what it refuses, and what can be typed while it runs."""

import pytest

from tests.wire.emulated import emulated_instruments, free_port, rig_text
from wavefocus.__main__ import run
from wavefocus.drivers.mirror.asi_tiger import AsiTiger
from wavefocus.drivers.protocols import WallClock
from wavefocus.drivers.registry import MirrorSettings
from wavefocus.drivers.serial_device import SerialMirror


def told(capsys):
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_given_a_virtual_rig_then_it_says_that_nothing_is_to_be_emulated(tmp_path, capsys):
    assert run(["init", str(tmp_path / "lab")]) == 0
    capsys.readouterr()
    assert run(["emulate", str(tmp_path / "lab" / "rig.toml")]) == 2
    assert "--rig emulated" in told(capsys)


def test_given_the_template_of_a_real_rig_then_it_names_the_rig_that_can_be_emulated(tmp_path, capsys):
    assert run(["init", "--rig", "template", str(tmp_path / "lab")]) == 0
    capsys.readouterr()
    assert run(["emulate", str(tmp_path / "lab" / "rig.toml")]) == 2
    assert "wavefocus init DIR --rig emulated" in told(capsys)


def test_given_a_port_where_something_is_then_it_is_left_alone(tmp_path, capsys):
    (tmp_path / "mirror").write_text("precious", encoding="utf-8")
    (tmp_path / "rig.toml").write_text(rig_text(tmp_path, "localhost:0"), encoding="utf-8")
    assert run(["emulate", str(tmp_path / "rig.toml")]) == 2
    assert "mirror.port" in told(capsys)
    assert (tmp_path / "mirror").read_text(encoding="utf-8") == "precious"


@pytest.mark.parametrize("wrong", ['port = "serial-number:ABC"', 'port = "no/such/folder/mirror"'])
def test_given_a_port_that_nothing_can_be_put_at_then_it_says_which(tmp_path, capsys, wrong):
    text = rig_text(tmp_path, f"localhost:{free_port()}")
    (tmp_path / "rig.toml").write_text(text.replace(f'port = "{tmp_path / "mirror"}"', wrong), encoding="utf-8")
    assert run(["emulate", str(tmp_path / "rig.toml")]) == 2
    assert "mirror.port" in told(capsys)


def test_given_a_recorder_without_an_address_then_it_says_what_to_give(tmp_path, capsys):
    text = rig_text(tmp_path, "localhost:1").replace('address = "localhost:1"', "")
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    assert run(["emulate", str(tmp_path / "rig.toml")]) == 2
    assert "recorder.address" in told(capsys)


def test_given_a_keyboard_then_the_spot_the_patch_bay_and_mistakes_are_answered(tmp_path):
    rig_file = tmp_path / "rig.toml"
    rig_file.write_text(rig_text(tmp_path, f"localhost:{free_port()}"), encoding="utf-8")
    with emulated_instruments(rig_file) as sides:
        assert sides.say("spot") == "spot: not on the plate"
        settings = MirrorSettings(
            port=str(tmp_path / "mirror"), settle_s=0.0, limit_mrad=155.0, park_mrad=(-150.0, -150.0), clock=WallClock()
        )
        mirror = SerialMirror(AsiTiger(), settings)
        mirror.move_to(30.0, -20.0)
        mirror.wait_settled(5.0)
        _, x_mm, y_mm, _ = sides.say("spot").split()
        mirror.close()
        assert float(x_mm) == pytest.approx(1000 * 0.030009, abs=0.2)
        assert float(y_mm) == pytest.approx(-1000 * 0.020003, abs=0.2)
        assert sides.say("patch output 2") == "the response input is connected to: output 2"
        assert "allowed: vibrometer, sum, both" in sides.say("patch kettle")
        assert "there is no 'vibrometer' here" in sides.say("unplug vibrometer")
        assert "patch vibrometer" in sides.say("make coffee")
        assert sides.close() == 0
    assert not (tmp_path / "mirror").is_symlink()
