"""Programs of others for the same devices, as clients of the emulated ones: how they read the answers."""

from __future__ import annotations

import math
import os
from contextlib import contextmanager

import pytest
from asitiger.errors import Errors
from asitiger.status import Status
from asitiger.tigercontroller import TigerController as AsiTigerClient
from tigerasi.tiger_controller import TigerController as TigerAsiClient

from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire.emulated_serial import EmulatedSerial, PtyWire
from wavefocus.mocks.wire.mirrors.asi_tiger import AsiTigerDevice

pytestmark = pytest.mark.skipif(os.name != "posix", reason="the clients open a serial port: a pseudo-terminal")


@contextmanager
def tiger(folder):
    motion = MirrorMotion((0.0, 0.0), 0.0, math.inf, 250.0)
    with EmulatedSerial(AsiTigerDevice(motion), PtyWire(folder / "port")) as far:
        yield far.address, motion


def test_given_asitiger_then_its_axes_moves_states_and_errors_are_those_of_a_tiger(tmp_path):
    with tiger(tmp_path) as (port, motion):
        client = AsiTigerClient.from_serial_port(port)
        assert [(axis.label, axis.type.value, axis.address) for axis in client.axes()] == [
            ("X", "x", "1"), ("Y", "x", "1"), ("A", "u", "2"), ("B", "u", "2")
        ]  # fmt: skip
        assert client.build(card_address=2)[0] == "MEMS"
        assert [line.partition(" ")[2].split()[0] for line in client.who()] == ["30:", "31:", "32:"]
        client.move({"X": 100, "A": 1000})
        client.wait_until_idle()
        client.move_relative({"X": -25.5})
        assert client.where(["X", "A"]) == {"X": 74.5, "A": 1000.0}
        # 1000 units are a degree of the mirror, two of the beam.
        assert motion.where_mrad() == pytest.approx((1000 * math.radians(2.0), 0.0))
        busy, axis = client.rdstat(["X?", "A"])
        assert (busy, axis.status, axis.enabled.value) == (Status.IDLE, Status.IDLE, 1)
        client.halt()
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


def test_given_tigerasi_then_it_finds_cards_by_two_digit_addresses_and_moves(tmp_path):
    with tiger(tmp_path) as (port, motion):
        client = TigerAsiClient(port)
        assert client.axis_to_card == {"X": ("31", 0), "Y": ("31", 1), "A": ("32", 0), "B": ("32", 1)}
        assert "RING BUFFER 250" in client._card_modules["32"]
        client.move_absolute(a=500, x=10)
        client.move_relative(x=5)
        assert client.get_position("a", "x") == {"X": 15.0, "A": 500.0}
        assert not any(client.is_moving().values())
        assert client.get_upper_travel_limit("a") == {"A": pytest.approx(4.6)}
        assert client.get_info("X")["Axis Name ChX"] == "X"
        client.set_speed(x=1.5)
        assert client.get_speed("x") == {"X": 1.5}
        client.zero_in_place("x")
        assert client.get_position("x") == {"X": 0.0}
        client.halt()
        assert motion.where_mrad()[0] == pytest.approx(500 * math.radians(2.0))
        client.ser.close()


# The lines of navigate's controller and of Micro-Manager's ASITiger adapter as they stand in their sources: neither can
# be installed beside this suite (one pins older versions, the other is not a Python package).
@pytest.mark.parametrize(
    ("command", "answer"),
    [
        ("MOVE X=100.0 A=500.0", ":A"),
        ("MOVREL X=7", ":A"),
        ("WHERE X", ":A 0.0"),
        ("RS X?", ":A N"),
        ("HALT", ":A"),
        ("SPEED X=1000 Y=1000", ":A"),
        ("SPEED X? Y?", ":A X=5.745920 Y=5.745920"),
        ("BU", "TIGER_COMM"),
        ("0 V", ":A v3.30"),
        ("0 CD", "Mar 01 2019:15:42:05"),
        ("0 BU", "TIGER_COMM"),
        ("2VB Z=1", ":A"),
        ("HM A?", ":A A=1000.000000"),
        ("UM A?", ":A A=1000.000"),
        ("RS A-", ":A f"),
    ],
)
def test_given_a_line_of_another_program_then_the_answer_is_in_the_form_that_it_reads(command, answer):
    device = AsiTigerDevice(MirrorMotion((0.0, 0.0), 0.0, math.inf, 250.0))
    assert device.answer(command).split("\r")[0].strip() == answer
