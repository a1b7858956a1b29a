"""A USB reset, asked for by a person, through the real pyusb on a virtual bus."""

from __future__ import annotations

import dataclasses

import pytest

from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.usb import list_devices, reset_device
from wavefocus.mocks.virtual.laboratory import VirtualClock
from wavefocus.mocks.wire.faults import WireFault
from wavefocus.mocks.wire.usb_backend import VirtualUsb, VirtualUsbDevice

DAQ = VirtualUsbDevice(0x3923, 0x7179, "01A2B3C4", "National Instruments", "USB-6211", port_path=(1, 2))
OTHER = VirtualUsbDevice(0x0403, 0x6001, "A50285BI", "FTDI", "FT232R USB UART", port_path=(1, 3))
RECORDER = ("recorder", 0x3923, 0x7179)


def bus_with(**changes: object) -> VirtualUsb:
    return VirtualUsb([dataclasses.replace(DAQ, **changes), OTHER])


def test_given_a_device_that_keeps_its_address_then_it_is_reset_and_found():
    bus = bus_with(after_reset="stays")
    before = list_devices(bus)
    assert reset_device(*RECORDER, backend=bus) == before[0]
    assert bus.open_handles == 0


@pytest.mark.parametrize("away_s", [0.0, 0.1])
def test_given_a_device_that_re_enumerates_then_it_is_found_under_its_new_address(away_s):
    bus = bus_with(after_reset="re-enumerates", away_s=away_s)
    before, other = list_devices(bus)
    after = reset_device(*RECORDER, backend=bus)
    assert after.address > before.address
    assert dataclasses.replace(after, address=before.address) == before
    assert other in list_devices(bus)
    assert bus.open_handles == 0


def test_given_a_device_without_a_serial_number_then_its_socket_tells_that_it_is_the_same():
    bus = VirtualUsb([dataclasses.replace(DAQ, serial_number="")])
    assert reset_device(*RECORDER, backend=bus).port_path == (1, 2)


def test_given_a_device_that_does_not_come_back_then_the_waiting_ends_with_what_to_do():
    bus, clock = bus_with(after_reset="stays away"), VirtualClock()
    with pytest.raises(InstrumentLostError, match="not back after 15 s") as caught:
        reset_device(*RECORDER, backend=bus, clock=clock)
    assert "recorder (USB 3923:7179)" in caught.value.instrument
    assert "plug it in again" in caught.value.remedy
    assert clock.now_s() == pytest.approx(15.0, abs=0.2)


class CannotReset(VirtualUsb):
    def reset_device(self, dev_handle):
        raise NotImplementedError("Operation not supported or unimplemented on this platform")


NO_PERMISSION = WireFault("usb", "no_permission", "open", at_call=1, count=1000)


@pytest.mark.parametrize(
    ("bus", "cause", "remedy"),
    [
        (lambda: bus_with(after_reset="refuses"), "Input/Output Error", "unplug it"),
        (lambda: bus_with(after_reset="busy"), "another program holds it", "close that program"),
        (lambda: VirtualUsb([DAQ], (NO_PERMISSION,)), "no permission to open it", ""),
        (lambda: CannotReset([DAQ]), "this system cannot do it", "unplug it"),
        (lambda: VirtualUsb([OTHER]), "it is not plugged in", "check its cable"),
        (lambda: VirtualUsb([DAQ, dataclasses.replace(DAQ, serial_number="2")]), "2 such devices", "serial_number"),
    ],
)
def test_given_a_reset_that_cannot_be_then_it_says_why_and_what_to_do_and_nothing_stays_open(bus, cause, remedy):
    bus = bus()
    with pytest.raises(InstrumentError, match=cause) as caught:
        reset_device(*RECORDER, backend=bus)
    assert caught.value.remedy
    assert remedy in caught.value.remedy
    assert bus.open_handles == 0


def test_given_a_device_unplugged_in_the_reset_then_it_is_waited_for():
    bus = VirtualUsb([DAQ], (WireFault("usb", "unplugged", "reset", at_call=1, seconds=0.2),))
    back = reset_device(*RECORDER, backend=bus)
    assert (back.serial_number, back.address) == ("01A2B3C4", 2)
