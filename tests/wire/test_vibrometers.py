"""Controllers of vibrometers on their lines: what each driver must do, and what only one of them has."""

import math
from contextlib import contextmanager
from itertools import cycle

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tests.lab_files import ABSENT_RIG, wire_fault
from tests.wire.serial_bench import LOCAL, HurriedClock, ImpatientClock, wire
from wavefocus.config.rig_instruments import VibrometerSection
from wavefocus.configuration import load_rig
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.registry import VIBROMETERS
from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire import WireFaultPlan
from wavefocus.mocks.wire.emulated_serial import EmulatedSerial
from wavefocus.mocks.wire.mirrors import GenericMirrorDevice
from wavefocus.mocks.wire.vibrometer import VIBROMETER_DRIVERS, Ofv3001Device, PolytecDevice, vibrometer_device
from wavefocus.rig.instruments import WatchedVibrometer, openers_of
from wavefocus.rig.setup import range_band

DEVICES = {"polytec-ofv5000": PolytecDevice, "polytec-ofv3001": Ofv3001Device}
NEWER, OLDER = DEVICES
SET_25_MM = {NEWER: "Set,VeloDec,1,Range,25mm/s/V", OLDER: "VELO2"}


@pytest.fixture(params=VIBROMETER_DRIVERS)
def driver(request):
    return str(request.param)


@contextmanager
def controller(device, folder, *faults):
    with EmulatedSerial(device, wire(LOCAL, folder), WireFaultPlan("vibrometer", faults)) as emulated:
        yield emulated


def read(driver, emulated, identity=None, clock=ImpatientClock, answer_s=0.2, **keys):
    return VIBROMETERS.all()[driver](**keys).read(emulated.address, identity=identity, answer_s=answer_s, clock=clock())


def read_alone(driver, device, folder, *faults, **keys):
    """The reading, and what was said to the device."""
    with controller(device, folder, *faults) as emulated:
        return read(driver, emulated, **keys), emulated.commands


def fault(kind, operation="range", count=1, **more):
    return wire_fault("vibrometer", kind, operation, at_call=1, count=count, **more)


def odd(device_class, answer, **settings):
    """A device whose answer to an operation and command is given, None for its own."""

    class Odd(device_class):  # type: ignore[misc, valid-type]
        def answer(self, command):
            text = answer(self.operation(command), command)
            return super().answer(command) if text is None else text

    return Odd(**settings)


# -- every vibrometer ----------------------------------------------------------------------------------


def test_range_and_level_are_read_echo_or_not_and_the_port_is_free_again(driver, tmp_path):
    assert set(VIBROMETER_DRIVERS) <= set(VIBROMETERS.all())
    device = DEVICES[driver](echo=True)
    with controller(device, tmp_path) as emulated:
        readings = [read(driver, emulated) for _ in range(2)]
        device.answer(SET_25_MM[driver])
        assert read(driver, emulated).sensitivity_m_s_per_v == pytest.approx(0.025)
    assert device.sensitivity_m_s_per_v == pytest.approx(0.025)
    assert readings[0] == readings[1]
    assert readings[0].sensitivity_m_s_per_v == pytest.approx(0.125)
    assert readings[0].range_text == "125mm/s/V"
    assert readings[0].latency_s == (pytest.approx(8.16e-6) if driver == NEWER else None)
    assert readings[0].signal_level == pytest.approx(600 / 775 if driver == NEWER else 31 / 40)
    assert {NEWER: "VD-09", OLDER: "OFV-3001, OVD-01"}[driver] in readings[0].identity


def test_given_too_little_light_or_another_identity_then_it_is_refused(driver, tmp_path):
    with controller(DEVICES[driver](signal_level={NEWER: 155, OLDER: 8}[driver]), tmp_path) as emulated:
        assert read(driver, emulated).signal_level == pytest.approx(0.2)
        with pytest.raises(InstrumentError, match="20 % of full, at least 50 % is wanted"):
            read(driver, emulated, least_signal_level=0.5)
        with pytest.raises(InstrumentError, match="does not contain 'OFV-2500'"):
            read(driver, emulated, identity="OFV-2500")


@pytest.mark.parametrize("kind", ["silent", "garbled", "truncated", "late"])
def test_given_one_lost_garbled_or_broken_off_answer_then_the_range_is_still_right(driver, kind, tmp_path):
    disturbed = fault(kind, seconds=0.3 if kind == "late" else 0.0)
    reading, _ = read_alone(driver, DEVICES[driver](echo=True), tmp_path, disturbed)
    assert reading.sensitivity_m_s_per_v == pytest.approx(0.125)


def test_what_is_always_garbled_or_another_device_is_an_error_and_never_a_range(driver, tmp_path):
    garbled = fault("garbled", count=100_000)
    with pytest.raises((TransientInstrumentError, InstrumentLostError)):
        read_alone(driver, DEVICES[driver](echo=True), tmp_path, garbled, clock=HurriedClock)
    another = GenericMirrorDevice(MirrorMotion((0.0, 0.0), 0.0, math.inf, 250.0))  # answers ERR 1 unknown command
    with pytest.raises(InstrumentLostError, match=r"asking who it is: .*driver and baud in the rig file"):
        read_alone(driver, another, tmp_path, clock=HurriedClock, answer_s=0.1)


def test_given_a_controller_unplugged_meanwhile_then_it_is_lost_until_it_is_back(driver, tmp_path):
    with controller(DEVICES[driver](echo=True), tmp_path, fault("unplugged")) as emulated:
        for _ in range(2):
            with pytest.raises(InstrumentLostError):
                read(driver, emulated)
        emulated.plug()
        assert read(driver, emulated).sensitivity_m_s_per_v == pytest.approx(0.125)


# -- OFV-5000 ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("range_text", "signal_delay", "signal_level", "sensitivity_m_s_per_v", "latency_s"),
    [
        ("20um/s/V", "8.16 us", 310, 2e-5, 8.16e-6),
        ("2,5mm/s/V", "8,16 us", "310,5", 0.0025, 8.16e-6),
        ("0.488281mm/s/V", "12.123456789us", "310.5", 0.000488281, 12.123456789e-6),
        ("1 m/s/V", "8 us", 310, 1.0, 8e-6),
        ("50 mm/s/V LP", "8.16 us", 310, 0.05, 8.16e-6),
        ("2.5m/s/V LP", "8.16 \xb5s", 310, 2.5, 8.16e-6),
        ("20\xb5m/s/V", "8.16\xc2\xb5s", 310, 2e-5, 8.16e-6),
    ],
)
def test_given_values_with_units_and_decimals_then_they_are_read(
    range_text, signal_delay, signal_level, sensitivity_m_s_per_v, latency_s, tmp_path
):
    device = PolytecDevice(range_text=range_text, signal_delay=signal_delay, signal_level=signal_level)
    reading, _ = read_alone(NEWER, device, tmp_path)
    assert reading.sensitivity_m_s_per_v == pytest.approx(sensitivity_m_s_per_v)
    assert reading.latency_s == pytest.approx(latency_s)
    assert reading.signal_level == pytest.approx(0.4, rel=2e-3)


@given(text=st.text(st.characters(min_codepoint=33, max_codepoint=126), max_size=12))
@example("125").via("no unit")
@example("0mm/s/V").via("zero")
@example("125mm/s").via("not per volt")
@example("125 km/s/V").via("no such unit")
@example("1e3mm/s/V").via("an exponent")
@example("125mm/s/V XY").via("more behind it")
def test_a_range_that_cannot_be_read_is_no_sensitivity(tmp_path_factory, text):
    with pytest.raises(InstrumentError, match="reading the measurement range: ") as caught:
        read_alone(NEWER, PolytecDevice(range_text=text), tmp_path_factory.mktemp("port"), answer_s=0.1)
    assert text.lower() in ("", "off") or "cannot be read" in caught.value.cause


def test_a_decoder_of_another_number_or_switched_off_is_named_and_no_cable_blamed(tmp_path):
    with controller(PolytecDevice(decoder=0), tmp_path) as emulated:
        assert read(NEWER, emulated, decoder=0).range_text == "125mm/s/V"
        with pytest.raises(InstrumentError, match=r"Not Available.*decoder's number in the rig file"):
            read(NEWER, emulated)
    with pytest.raises(InstrumentError, match=r"off.*; .*range at the controller") as caught:
        read_alone(NEWER, PolytecDevice(range_text="off"), tmp_path)
    assert type(caught.value) is InstrumentError


@pytest.mark.parametrize("operation", ["name", "delay", "level"])
@pytest.mark.parametrize("answer", ["\xb5\xe9 \xff", "", "see display", None])
def test_an_optional_answer_that_cannot_be_read_then_the_reading_goes_on_without_it(operation, answer, tmp_path):
    text = None if answer is None else f"{answer}\n"
    device = odd(PolytecDevice, lambda asked, _: text if asked == operation else None)
    refused = [fault("refused", operation)] if answer is None else []
    reading, _ = read_alone(NEWER, device, tmp_path, *refused, answer_s=0.1)
    assert reading.sensitivity_m_s_per_v == pytest.approx(0.125)
    assert (reading.latency_s is None) == (operation == "delay")
    assert (reading.signal_level is None) == (operation == "level")
    assert ("VD-09" in reading.identity) == (operation != "name")


@pytest.mark.parametrize("silent", ["Get,Controller", "GetDevInfo,Controller"])
@pytest.mark.parametrize("name", ["OFV-5000", "OFV-5000Xtra", "OFV-5000 Vibrometer Controller"])
def test_a_controller_is_asked_the_question_for_its_name_that_it_knows(silent, name, tmp_path):
    def answer(operation, command):
        return None if operation != "identify" else "" if command.startswith(silent) else f"{name}\n"

    reading, _ = read_alone(NEWER, odd(PolytecDevice, answer), tmp_path, answer_s=0.1)
    assert reading.identity == f"{name}, VD-09"


def test_range_that_is_changed_meanwhile_then_condition_is_left_until_it_is_set_back(tmp_path):
    device = PolytecDevice()
    with controller(device, tmp_path) as emulated:
        vibrometer = WatchedVibrometer(VibrometerSection(driver=NEWER, port=emulated.address))
        band = range_band(read(NEWER, emulated).sensitivity_m_s_per_v)
        for text, words in (("", ""), ("25mm/s/V", "is below"), ("1m/s/V", "is above"), ("125mm/s/V", "")):
            if text:
                device.answer(f"Set,VeloDec,1,Range,{text}")
            vibrometer.light()
            left = band.left(vibrometer.sensitivity())
            assert words in left
            assert bool(left) == bool(words)


def test_a_sensitivity_in_the_rig_file_that_the_controller_has_not_is_refused(tmp_path):
    rig, named = tmp_path / "rig.toml", ABSENT_RIG.format(folder=tmp_path) + f'[vibrometer]\ndriver = "{NEWER}"\n'
    with controller(PolytecDevice("25mm/s/V"), tmp_path) as emulated:
        for stated in ("", "sensitivity_m_s_per_v = 0.025", "sensitivity_m_s_per_v = 0.125"):
            rig.write_text(f'{named}port = "{emulated.address}"\n{stated}', encoding="utf-8")
            opened = openers_of(load_rig(rig)).vibrometer
            if "0.125" not in stated:
                assert opened().sensitivity_m_s_per_v == pytest.approx(0.025)
        with pytest.raises(InstrumentError, match=r"set to 25mm/s/V, the rig file says 0\.125 m/s per V") as told:
            opened()
        assert "correct vibrometer.sensitivity_m_s_per_v" in told.value.remedy


# -- OFV-3001: range numbers, remote control, answers of one digit --------------------------------------


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
    reading, commands = read_alone(OLDER, device, tmp_path)
    assert reading.sensitivity_m_s_per_v == pytest.approx(1e-3 * mm_s_per_v)
    assert reading.identity == f"OFV-3001, {decoder}"
    assert set(commands) <= {"VELO?", "LEV", ""}


@pytest.mark.parametrize("level", ["41", "", "x", "LEV-1"])
def test_under_local_control_remote_is_switched_on_and_an_odd_level_is_unknown(level, tmp_path):
    device = odd(Ofv3001Device, lambda asked, _: f"{level}\n" if asked == "level" else None, needs_remote=True)
    reading, commands = read_alone(OLDER, device, tmp_path)
    assert "REN" in commands
    assert reading.signal_level is None
    assert reading.range_text == "125mm/s/V"


@pytest.mark.parametrize("answers", [["3\n", "4\n"], ["0\n"], ["10\n"], ["VELO\n"], ["OFV-5000\n"], ["3.0\n"], [""]])
def test_answers_that_differ_are_no_range_or_do_not_come_then_there_is_no_reading(answers, tmp_path):
    given = cycle(answers)
    with pytest.raises(InstrumentError) as caught:
        read_alone(OLDER, odd(Ofv3001Device, lambda *_: next(given)), tmp_path, clock=HurriedClock, answer_s=0.1)
    if answers == [""]:
        assert type(caught.value) is InstrumentLostError
        assert "baud" in caught.value.remedy


def test_a_sensitivity_that_no_range_has_then_its_key_is_named():
    assert vibrometer_device(OLDER, 0.005, 0.0).sensitivity_m_s_per_v == pytest.approx(0.005)
    with pytest.raises(ValueError, match=r"sensitivity_m_s_per_v = 0\.1"):
        vibrometer_device(OLDER, 0.1, 0.0)
