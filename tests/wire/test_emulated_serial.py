"""The emulated instruments by themselves, as a person at a terminal would meet them."""

import math
import re
import socket
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire import WireFault, WireFaultPlan
from wavefocus.mocks.wire.emulated_serial import EmulatedSerial, TcpWire
from wavefocus.mocks.wire.mirrors import GenericMirrorDevice
from wavefocus.mocks.wire.vibrometer import PolytecDevice

REFERENCE = Path(__file__).parents[2] / "docs/reference/generic-mirror.md"


def motion():
    return MirrorMotion((-200.0, -200.0), 0.0, math.inf, 250.0)


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
    with terminal(GenericMirrorDevice(MirrorMotion((0.0, 0.0), 0.0, math.inf, 200.0))) as ask:
        for said, heard in exchanges:
            answer = ask(said).strip()
            # Its mirror jumps, so it is never busy.
            assert answer == ("0*30" if said.startswith("BUSY?") else heard)


def test_given_polytec_then_it_answers_as_public_programs_expect():
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


def test_given_a_fault_at_a_time_then_it_strikes_by_the_clock():
    with terminal(GenericMirrorDevice(motion()), WireFault("mirror", "refused", "busy", at_s=0.0)) as ask:
        assert ask("BUSY?").startswith("ERR 5")
        assert ask("BUSY?") == "0\r\n"
