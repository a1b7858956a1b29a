"""What every vibrometer's controller must do, through its driver."""

from collections.abc import Callable
from contextlib import contextmanager

import pytest

from tests.wire.serial_bench import LOCAL, HurriedClock, ImpatientClock, wire
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.registry import VIBROMETERS
from wavefocus.mocks.wire import WireFault, WireFaultPlan
from wavefocus.mocks.wire.emulated_serial import EmulatedSerial
from wavefocus.mocks.wire.vibrometer import VIBROMETER_DRIVERS, Ofv3001Device, PolytecDevice, VibrometerDevice

NAMES = {"polytec-ofv5000": "VD-09", "polytec-ofv3001": "OFV-3001, OVD-01"}
SET_25_MM = {"polytec-ofv5000": "Set,VeloDec,1,Range,25mm/s/V", "polytec-ofv3001": "VELO2"}
WEAK: dict[str, Callable[[], VibrometerDevice]] = {
    "polytec-ofv5000": lambda: PolytecDevice(signal_level=155),
    "polytec-ofv3001": lambda: Ofv3001Device(signal_level=8),
}
ECHOING: dict[str, Callable[[], VibrometerDevice]] = {
    "polytec-ofv5000": lambda: PolytecDevice(echo=True),
    "polytec-ofv3001": lambda: Ofv3001Device(echo=True),
}


@pytest.fixture(params=VIBROMETER_DRIVERS)
def driver(request):
    return str(request.param)


@contextmanager
def controller(device, folder, *faults):
    with EmulatedSerial(device, wire(LOCAL, folder), WireFaultPlan("vibrometer", faults)) as emulated:
        yield emulated


def read(driver, emulated, identity=None, clock=ImpatientClock, **keys):
    opened = VIBROMETERS.all()[driver](**keys)  # type: ignore[call-arg]
    return opened.read(  # type: ignore[call-arg]
        emulated.address, identity=identity, answer_s=0.2, clock=clock()
    )


def fault(kind, count=1):
    return WireFault("vibrometer", kind, "range", at_call=1, count=count)


def test_given_the_driver_then_it_is_registered_and_can_be_emulated():
    assert set(VIBROMETER_DRIVERS) <= set(VIBROMETERS.all())


def test_controller_then_range_and_level_are_read_echo_or_not_and_port_is_free_again(driver, tmp_path):
    with controller(ECHOING[driver](), tmp_path) as emulated:
        readings = [read(driver, emulated) for _ in range(2)]
    assert readings[0] == readings[1]
    assert readings[0].sensitivity_m_s_per_v == pytest.approx(0.125)
    assert readings[0].range_text == "125mm/s/V"
    assert readings[0].latency_s == (pytest.approx(8.16e-6) if driver == "polytec-ofv5000" else None)
    assert readings[0].signal_level == pytest.approx(600 / 775 if driver == "polytec-ofv5000" else 31 / 40)
    assert NAMES[driver] in readings[0].identity


def test_given_another_range_set_at_the_controller_then_it_is_read(driver, tmp_path):
    device = ECHOING[driver]()
    with controller(device, tmp_path) as emulated:
        device.answer(SET_25_MM[driver])
        assert read(driver, emulated).sensitivity_m_s_per_v == pytest.approx(0.025)
    assert device.sensitivity_m_s_per_v == pytest.approx(0.025)


def test_given_too_little_light_or_another_identity_then_it_is_refused(driver, tmp_path):
    with controller(WEAK[driver](), tmp_path) as emulated:
        assert read(driver, emulated).signal_level == pytest.approx(0.2)
        with pytest.raises(InstrumentError, match="20% of full, at least 50% is wanted"):
            read(driver, emulated, least_signal_level=0.5)
        with pytest.raises(InstrumentError, match="does not contain 'OFV-2500'"):
            read(driver, emulated, identity="OFV-2500")


def test_given_one_lost_garbled_or_broken_off_answer_then_the_range_is_still_right(driver, tmp_path):
    for number, kind in enumerate(("silent", "garbled", "truncated", "late")):
        late = WireFault("vibrometer", kind, "range", at_call=1, count=1, seconds=0.3 if kind == "late" else 0.0)
        folder = tmp_path / str(number)
        folder.mkdir()
        with controller(ECHOING[driver](), folder, late) as emulated:
            assert read(driver, emulated).sensitivity_m_s_per_v == pytest.approx(0.125)


def test_a_controller_that_stops_answering_then_it_is_an_error_and_never_a_range(driver, tmp_path):
    with (
        controller(ECHOING[driver](), tmp_path, fault("garbled", count=100_000)) as emulated,
        pytest.raises((TransientInstrumentError, InstrumentLostError)),
    ):
        read(driver, emulated, clock=HurriedClock)


def test_given_a_controller_unplugged_meanwhile_then_it_is_lost_until_it_is_back(driver, tmp_path):
    with controller(ECHOING[driver](), tmp_path, fault("unplugged")) as emulated:
        for _ in range(2):
            with pytest.raises(InstrumentLostError):
                read(driver, emulated)
        emulated.plug()
        assert read(driver, emulated).sensitivity_m_s_per_v == pytest.approx(0.125)
