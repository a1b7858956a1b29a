"""The vibrometer's sensitivity, read over both wires, with spot checks of the serial faults."""

from contextlib import contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.wire.serial_bench import LOCAL, ImpatientClock, wire
from wavefocus.config.rig_instruments import VibrometerSection
from wavefocus.drivers.errors import InstrumentError, TransientInstrumentError
from wavefocus.drivers.vibrometer.polytec import Polytec
from wavefocus.mocks.wire import WireFault, WireFaultPlan
from wavefocus.mocks.wire.emulated_serial import EmulatedSerial
from wavefocus.mocks.wire.vibrometer import PolytecDevice
from wavefocus.rig.setup import WatchedVibrometer, range_band

ANSWER_S = 0.3


@contextmanager
def controller(kind, folder, *faults, **settings_):
    device = PolytecDevice(**settings_)
    with EmulatedSerial(device, wire(kind, folder), WireFaultPlan("vibrometer", faults)) as far:
        yield far


def read(far, *, answer_s=ANSWER_S, **keys):
    return Polytec(**keys).read(far.address, answer_s=answer_s, clock=ImpatientClock())


def fault(kind, operation="range", count=1, **more):
    return WireFault("vibrometer", kind, operation, at_call=1, count=count, **more)


@pytest.mark.parametrize(
    ("range_text", "signal_delay", "signal_level", "sensitivity_m_s_per_v", "latency_s"),
    [
        ("5mm/s/V", "8.16 us", 310, 5e-3, 8.16e-6),
        ("20um/s/V", "8.16 us", 310, 2e-5, 8.16e-6),
        ("2,5mm/s/V", "8,16 us", "310,5", 0.0025, 8.16e-6),
        ("0.488281mm/s/V", "12.123456789us", "310.5", 0.000488281, 12.123456789e-6),
        ("1 m/s/V", "8 us", 310, 1.0, 8e-6),
        ("125mm/s/V LP", "8.16 us", 310, 0.125, 8.16e-6),
        ("50 mm/s/V LP", "8.16 us", 310, 0.05, 8.16e-6),
        ("2.5m/s/V LP", "8.16 \xb5s", 310, 2.5, 8.16e-6),
        ("20\xb5m/s/V", "8.16\xc2\xb5s", 310, 2e-5, 8.16e-6),
    ],
)
def test_given_values_with_units_and_decimals_then_they_are_read(
    range_text, signal_delay, signal_level, sensitivity_m_s_per_v, latency_s, tmp_path
):
    with controller(
        LOCAL, tmp_path, range_text=range_text, signal_delay=signal_delay, signal_level=signal_level
    ) as far:
        reading = read(far)
    assert reading.sensitivity_m_s_per_v == pytest.approx(sensitivity_m_s_per_v)
    assert reading.latency_s == pytest.approx(latency_s)
    assert reading.signal_level == pytest.approx(0.4, rel=2e-3)


@pytest.mark.parametrize("text", ["125", "0mm/s/V", "125mm/s", "125 km/s/V", "1e3mm/s/V", "125mm/s/V XY"])
def test_given_a_range_that_cannot_be_read_then_it_is_no_sensitivity(text, tmp_path):
    with (
        controller(LOCAL, tmp_path, range_text=text) as far,
        pytest.raises(TransientInstrumentError, match=r"reading the measurement range: .*cannot be read"),
    ):
        read(far)


def test_a_missing_decoder_has_its_number_asked_for_and_is_read_with_it(tmp_path):
    with controller(LOCAL, tmp_path, decoder=0) as far:
        assert read(far, decoder=0).range_text == "125mm/s/V"
        with pytest.raises(InstrumentError, match=r"Not Available.*decoder's number in the rig file"):
            read(far)


def test_given_a_controller_that_does_not_know_delay_and_level_then_they_are_unknown(tmp_path):
    with controller(LOCAL, tmp_path, fault("refused", "delay"), fault("refused", "level")) as far:
        reading = read(far)
    assert reading.latency_s is None
    assert reading.signal_level is None


@pytest.mark.parametrize("text", ["Off", "off"])
def test_a_decoder_that_is_switched_off_then_that_is_said_and_not_the_cable_blamed(text, tmp_path):
    with controller(LOCAL, tmp_path, range_text=text) as far, pytest.raises(InstrumentError) as caught:
        read(far)
    assert type(caught.value) is InstrumentError
    assert "Off" in caught.value.cause
    assert "range at the controller" in caught.value.remedy


@pytest.mark.parametrize("operation", ["name", "delay", "level"])
@pytest.mark.parametrize("answer", ["\xb5\xe9 \xff", "", "see display"])
def test_an_optional_answer_that_cannot_be_read_then_the_reading_goes_on_without_it(operation, answer, tmp_path):
    class Odd(PolytecDevice):
        def answer(self, command):
            return f"{answer}\n" if self.operation(command) == operation else super().answer(command)

    with EmulatedSerial(Odd(), wire(LOCAL, tmp_path)) as far:
        reading = read(far, answer_s=0.1)
    assert reading.sensitivity_m_s_per_v == pytest.approx(0.125)
    assert (reading.latency_s is None) == (operation == "delay")
    assert (reading.signal_level is None) == (operation == "level")
    assert ("VD-09" in reading.identity) == (operation != "name")


@pytest.mark.parametrize("silent", ["Get,Controller", "GetDevInfo,Controller"])
@pytest.mark.parametrize("name", ["OFV-5000", "OFV-5000Xtra", "OFV-5000 Vibrometer Controller"])
def test_a_controller_is_asked_the_question_for_its_name_that_it_knows(silent, name, tmp_path):
    class KnowsOne(PolytecDevice):
        def answer(self, command):
            if self.operation(command) != "identify":
                return super().answer(command)
            return "" if command.startswith(silent) else f"{name}\n"

    with EmulatedSerial(KnowsOne(), wire(LOCAL, tmp_path)) as far:
        assert read(far, answer_s=0.1).identity == f"{name}, VD-09"


@given(text=st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=12))
def test_given_arbitrary_text_for_a_range_then_it_is_an_error(tmp_path_factory, text):
    with controller(LOCAL, tmp_path_factory.mktemp("port"), range_text=text) as far, pytest.raises(InstrumentError):
        read(far, answer_s=0.1)


def test_range_that_is_changed_meanwhile_then_condition_is_left_until_it_is_set_back(tmp_path):
    device = PolytecDevice()
    with EmulatedSerial(device, wire(LOCAL, tmp_path), WireFaultPlan("vibrometer", ())) as far:
        section = VibrometerSection(driver="polytec-ofv5000", port=far.address)
        vibrometer = WatchedVibrometer(section)
        band = range_band(read(far).sensitivity_m_s_per_v)

        def left():
            vibrometer.light()
            return band.left(vibrometer.sensitivity())

        assert left() == ""
        for text, words in (("25mm/s/V", "is below"), ("1m/s/V", "is above"), ("125mm/s/V", "")):
            device.answer(f"Set,VeloDec,1,Range,{text}")
            assert words in left()
            assert bool(left()) == bool(words)
