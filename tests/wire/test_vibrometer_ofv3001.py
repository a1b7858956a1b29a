"""What only an OFV-3001 has: range numbers, remote control, answers of one digit."""

import pytest

from tests.wire.serial_bench import LOCAL, HurriedClock, ImpatientClock, wire
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.vibrometer.polytec import PolytecOfv3001
from wavefocus.mocks.wire.emulated_serial import EmulatedSerial
from wavefocus.mocks.wire.vibrometer import Ofv3001Device, vibrometer_device


def read(device, folder, clock=ImpatientClock):
    with EmulatedSerial(device, wire(LOCAL, folder)) as emulated:
        reading = PolytecOfv3001().read(emulated.address, answer_s=0.1, clock=clock())
        return reading, emulated.commands


# The table of ranges in the user manual, E.2.4: number, decoder, mm/s/V.
@pytest.mark.parametrize(
    ("number", "decoder", "mm_s_per_v"),
    [(5, "OVD-01", 1), (1, "OVD-01", 5), (2, "OVD-01", 25), (3, "OVD-01", 125), (4, "OVD-01", 1000),
     (6, "OVD-02", 5), (7, "OVD-02", 25), (8, "OVD-02", 125), (9, "OVD-02", 1000)],
)  # fmt: skip
def test_given_a_range_number_then_decoder_and_sensitivity_are_those_of_the_manual(
    number, decoder, mm_s_per_v, tmp_path
):
    device = Ofv3001Device()
    device.answer(f"VELO{number}")
    reading, commands = read(device, tmp_path)
    assert reading.sensitivity_m_s_per_v == pytest.approx(1e-3 * mm_s_per_v)
    assert reading.identity == f"OFV-3001, {decoder}"
    assert reading.latency_s is None
    assert set(commands) <= {"VELO?", "LEV", ""}


def test_controller_under_local_control_then_it_is_put_under_remote_control_and_read(tmp_path):
    reading, commands = read(Ofv3001Device(needs_remote=True), tmp_path)
    assert reading.range_text == "125mm/s/V"
    assert "REN" in commands


@pytest.mark.parametrize("level", ["41", "", "x", "LEV-1"])
def test_given_a_level_that_cannot_be_then_it_is_unknown_and_the_range_is_read(level, tmp_path):
    class Odd(Ofv3001Device):
        def answer(self, command):
            return f"{level}\n" if command == "LEV" else super().answer(command)

    reading, _ = read(Odd(), tmp_path)
    assert reading.signal_level is None
    assert reading.sensitivity_m_s_per_v == pytest.approx(0.125)


@pytest.mark.parametrize("answers", [["3", "4"], ["0"], ["10"], ["VELO"], ["OFV-5000"], ["3.0"]])
def test_given_answers_that_differ_or_are_no_range_then_there_is_no_reading(answers, tmp_path):
    class Odd(Ofv3001Device):
        asked = 0

        def answer(self, command):
            self.asked += 1
            return f"{answers[self.asked % len(answers)]}\n"

    with pytest.raises(InstrumentError):
        read(Odd(), tmp_path, HurriedClock)


def test_given_no_answer_at_all_then_the_remedy_names_cable_and_baud(tmp_path):
    class Silent(Ofv3001Device):
        def answer(self, command):
            return ""

    with pytest.raises(InstrumentLostError) as caught:
        read(Silent(), tmp_path, HurriedClock)
    assert "baud" in caught.value.remedy


def test_a_range_of_a_decoder_that_is_not_installed_then_the_emulated_one_ignores_it():
    device = Ofv3001Device(decoders=("OVD-01",))
    for command in ("VELO7", "VELO0", "VELOX", "NONSENSE"):
        assert device.answer(command) == ""
    assert device.answer("VELO?") == "3\n"
    device.answer("ECHOON")
    assert [device.answer(word) for word in ("VELO?", "VELO2", "OVR", "LEV")] == [
        "VELO3\n", "VELO2\n", "OVR0\n", "LEV31\n"
    ]  # fmt: skip


def test_given_a_sensitivity_that_no_range_has_then_it_cannot_be_emulated():
    assert vibrometer_device("polytec-ofv3001", 0.005, 0.0).sensitivity_m_s_per_v == pytest.approx(0.005)
    with pytest.raises(ValueError, match=r"sensitivity_m_s_per_v = 0\.1"):
        vibrometer_device("polytec-ofv3001", 0.1, 0.0)
