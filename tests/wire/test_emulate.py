"""``wavefocus emulate``: what it refuses, what can be typed while it runs, and its serial devices by themselves."""

import math
import os
import re
import socket
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from asitiger.errors import Errors
from asitiger.tigercontroller import TigerController as AsiTigerClient

from tests.lab_files import wire_fault
from tests.system.captures import refused
from tests.wire.emulated import emulated_instruments, free_port, rig_text
from wavefocus.__main__ import run
from wavefocus.drivers.mirror.asi_tiger import AsiTiger
from wavefocus.drivers.protocols import WallClock
from wavefocus.drivers.registry import MirrorSettings
from wavefocus.drivers.serial_device import SerialMirror
from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire import WireFaultPlan
from wavefocus.mocks.wire.asi_tiger import AsiTigerDevice
from wavefocus.mocks.wire.emulated_serial import EmulatedSerial, PtyWire, TcpWire
from wavefocus.mocks.wire.mirrors import GenericMirrorDevice
from wavefocus.mocks.wire.vibrometer import PolytecDevice


@pytest.mark.parametrize(
    ("kind", "old", "new", "named"),
    [
        ("virtual", "", "", "--rig emulated"),
        ("template", "", "", "wavefocus init DIR --rig emulated"),
        ("", "", "", "mirror.port"),  # where a file is
        ("", 'port = "{folder}/mirror"', 'port = "serial-number:ABC"', "mirror.port"),
        ("", 'port = "{folder}/mirror"', 'port = "no/such/folder/mirror"', "mirror.port"),
        ("", 'address = "localhost:1"', "", "recorder.address"),
    ],
)
def test_a_rig_that_cannot_be_emulated_is_refused_in_one_line(tmp_path, capsys, kind, old, new, named):
    rig_file, port = tmp_path / "lab" / "rig.toml", tmp_path / "mirror"
    assert run(["init", "--rig", kind or "emulated", str(rig_file.parent)]) == 0
    port.write_text("precious", encoding="utf-8")
    if not kind:
        rig_file.write_text(rig_text(tmp_path, "localhost:1").replace(old.format(folder=tmp_path), new))
    assert named in refused(capsys, "emulate", rig_file)
    assert port.read_text(encoding="utf-8") == "precious"


@pytest.mark.long
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


# -- emulated serial devices, as a person at a terminal or a program of others meets them ------------------


REFERENCE = Path(__file__).parents[2] / "docs/reference/generic-mirror.md"


def motion(limit_mrad=250.0):
    return MirrorMotion((0.0, 0.0), 0.0, math.inf, limit_mrad)


@contextmanager
def terminal(device, *faults):
    """A person's terminal: sends lines and reads lines."""
    with EmulatedSerial(device, TcpWire(), WireFaultPlan(device.role, faults)) as far:
        parts = urlsplit(far.address)
        with socket.create_connection((parts.hostname, parts.port), timeout=30) as line, line.makefile("rb") as answers:

            def ask(command, end=device.command_end):
                line.sendall((command + end).encode())
                return answers.readline().decode()

            yield ask


def test_given_the_reference_page_then_the_device_holds_the_conversation_in_it():
    block = re.search(r"## A conversation\n\n```\n(.*?)```", REFERENCE.read_text(encoding="utf-8"), re.DOTALL)
    lines = [line for line in block.group(1).splitlines() if line]
    exchanges = [(said[2:], heard[2:]) for said, heard in zip(lines[::2], lines[1::2], strict=True)]
    assert all(said.startswith("> ") for said in lines[::2])
    with terminal(GenericMirrorDevice(motion(200.0))) as ask:
        for said, heard in exchanges:
            answer = ask(said).strip()
            # Its mirror jumps, so it is never busy.
            assert answer == ("0*30" if said.startswith("BUSY?") else heard)
    with terminal(GenericMirrorDevice(motion()), wire_fault("mirror", "refused", "busy", at_s=0.0)) as ask:
        assert [ask("BUSY?")[:5], ask("BUSY?")] == ["ERR 5", "0\r\n"]


def test_given_polytec_or_a_tiger_then_it_answers_as_public_programs_expect():
    # Micro-Manager's adapter.
    for command, answer in (("0 V", ":A v3.30"), ("0 CD", "Mar 01 2019:15:42:05"), ("0 BU", "TIGER_COMM")):
        assert AsiTigerDevice(motion()).answer(command).split("\r")[0].strip() == answer
    device = PolytecDevice()
    with terminal(device) as ask:
        assert ask("GetDevInfo,Controller,0,Name") == "OFV-5000 Vibrometer Controller\n"
        assert ask("GetDevInfo,controller,0,Name\r") == "OFV-5000 Vibrometer Controller\n"
        assert ask("Get,Controller,0,Name") == "OFV-5000\n"
        assert ask("Get,Interface,0,Echo") == "Off\n"
        assert ask("Get,VeloDec,1,MaxFreq") == "1.5MHz\n"
        assert ask("Get,VeloDec,0,Range") == "Not Available\n"
        assert ask("Get,VeloDec,1,SignalDelay") == "8.16 us\n"
        assert ask("Get,SignalLevel,0,Value") == "600\n"
        assert ask("Get,Laser,0,Colour") == "Not Available\n"
        assert ask("Set,VeloDec,1,Range,5mm/s/V LP\nGet,VeloDec,1,Range") == "5mm/s/V LP\n"
        assert device.sensitivity_m_s_per_v == pytest.approx(0.005)
        for refused in ("7mm/s/V", "on", ""):
            assert ask(f"Set,VeloDec,1,Range,{refused}\nGet,VeloDec,1,Range") == "5mm/s/V LP\n"
        assert ask("Set,VeloDec,1,Range,Off\nGet,VeloDec,1,Range") == "Off\n"
        assert "125mm/s/V LP" in ask("GetDevInfo,VeloDec,1,Range").split(",")


@pytest.mark.skipif(os.name != "posix", reason="the client opens a serial port: a pseudo-terminal")
def test_given_asitiger_then_its_axes_moves_and_errors_are_those_of_a_tiger(tmp_path):
    scanner = motion()
    with EmulatedSerial(AsiTigerDevice(scanner), PtyWire(tmp_path / "port")) as far:
        client = AsiTigerClient.from_serial_port(far.address)
        assert [(axis.label, axis.type.value, axis.address) for axis in client.axes()] == [
            ("X", "x", "1"), ("Y", "x", "1"), ("A", "u", "2"), ("B", "u", "2")
        ]  # fmt: skip
        assert client.build(card_address=2)[0] == "MEMS"
        client.move({"X": 100, "A": 1000})
        client.wait_until_idle()
        assert client.where(["X", "A"]) == {"X": 100.0, "A": 1000.0}
        # 1000 units are a degree of the mirror, two of the beam.
        assert scanner.where_mrad() == pytest.approx((1000 * math.radians(2.0), 0.0))
        for command, error in [
            ({"Q": 1}, Errors.UnrecognizedAxisParameterError),
            ({"A": 9000}, Errors.ParameterOutOfRangeError),
        ]:
            with pytest.raises(error):
                client.move(command)
        with pytest.raises(Errors.UnknownCommandError):
            client.send_command("JUMP")
        with pytest.raises(Errors.InvalidCardAddressException):
            client.build(card_address=7)
        client.connection.disconnect()
