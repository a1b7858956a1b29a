"""A program of others for the same device, as a client of the emulated one: how it reads the answers."""

import math
import os

import pytest
from asitiger.errors import Errors
from asitiger.tigercontroller import TigerController as AsiTigerClient

from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire.asi_tiger import AsiTigerDevice
from wavefocus.mocks.wire.emulated_serial import EmulatedSerial, PtyWire

pytestmark = pytest.mark.skipif(os.name != "posix", reason="the clients open a serial port: a pseudo-terminal")


def test_given_asitiger_then_its_axes_moves_and_errors_are_those_of_a_tiger(tmp_path):
    motion = MirrorMotion((0.0, 0.0), 0.0, math.inf, 250.0)
    with EmulatedSerial(AsiTigerDevice(motion), PtyWire(tmp_path / "port")) as far:
        client = AsiTigerClient.from_serial_port(far.address)
        assert [(axis.label, axis.type.value, axis.address) for axis in client.axes()] == [
            ("X", "x", "1"), ("Y", "x", "1"), ("A", "u", "2"), ("B", "u", "2")
        ]  # fmt: skip
        assert client.build(card_address=2)[0] == "MEMS"
        client.move({"X": 100, "A": 1000})
        client.wait_until_idle()
        assert client.where(["X", "A"]) == {"X": 100.0, "A": 1000.0}
        # 1000 units are a degree of the mirror, two of the beam.
        assert motion.where_mrad() == pytest.approx((1000 * math.radians(2.0), 0.0))
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


@pytest.mark.parametrize(
    ("command", "answer"), [("0 V", ":A v3.30"), ("0 CD", "Mar 01 2019:15:42:05"), ("0 BU", "TIGER_COMM")]
)
def test_line_of_micro_managers_adapter_then_answer_is_in_form_that_it_reads(command, answer):
    device = AsiTigerDevice(MirrorMotion((0.0, 0.0), 0.0, math.inf, 250.0))
    assert device.answer(command).split("\r")[0].strip() == answer
