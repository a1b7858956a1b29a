"""What is plugged in, seen by the real pyusb on a virtual bus."""

from __future__ import annotations

import errno
import re
from pathlib import Path

import pytest
import usb.core

from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.serial_line import RULES
from wavefocus.drivers.usb import (
    SERIAL_ADAPTERS,
    ExpectedUsbDevice,
    Finding,
    Kind,
    Problem,
    Verdict,
    list_devices,
    match_devices,
    permit,
    udev_rule,
)
from wavefocus.mocks.wire.faults import WireFault
from wavefocus.mocks.wire.usb_backend import VirtualUsb, VirtualUsbDevice

DAQ = VirtualUsbDevice(0x3923, 0x7179, "01A2B3C4", "National Instruments", "USB-6211", port_path=(1, 2))
ADAPTER = VirtualUsbDevice(0x0403, 0x6001, "A50285BI", "FTDI", "FT232R USB UART", port_path=(1, 3))
SECOND_ADAPTER = VirtualUsbDevice(0x0403, 0x6001, "A7004IXX", "FTDI", "FT232R USB UART", port_path=(1, 4))
AUDIO = VirtualUsbDevice(0x07FD, 0x0005, "", "MOTU", "24Ao", interface_classes=(0x01, 0x01, 0x03), bus=2)
HUB = VirtualUsbDevice(0x05E3, 0x0610, product="Hub", interface_classes=(9,), device_class=9, port_path=())

SWAPPED = VirtualUsbDevice(0x0403, 0x6001, "NEW1", port_path=(1, 3))
NO_PERMISSION = WireFault("usb", "no_permission", "open", at_call=1, count=1000)


def found(bus: VirtualUsb, *expected: ExpectedUsbDevice, platform: str = "linux") -> tuple[Finding, ...]:
    return match_devices(expected, list_devices(bus), platform)


def expect(device: VirtualUsbDevice, serial_number: str | None = None, role: str = "recorder") -> ExpectedUsbDevice:
    return ExpectedUsbDevice(role, device.vendor_id, device.product_id, serial_number)


def test_given_a_bus_then_each_device_is_listed_with_its_ids_texts_place_and_kind():
    bus = VirtualUsb([HUB, DAQ, ADAPTER, AUDIO])
    hub, daq, adapter, audio = list_devices(bus)
    assert bus.open_handles == 0
    assert (daq.vendor_id, daq.product_id, daq.kind) == (0x3923, 0x7179, Kind.DAQ)
    assert (daq.manufacturer, daq.product, daq.serial_number) == ("National Instruments", "USB-6211", "01A2B3C4")
    assert (daq.bus, daq.address, daq.port_path) == (1, 2, (1, 2))
    assert [one.kind for one in (hub, adapter, audio)] == [Kind.HUB, Kind.SERIAL_ADAPTER, Kind.AUDIO]
    assert (audio.bus, audio.serial_number) == (2, None)
    assert all(one.problem is Problem.NONE for one in (hub, daq, adapter, audio))
    assert str(daq) == "3923:7179 National Instruments USB-6211, serial number 01A2B3C4, bus 1 port 1.2"


def test_given_what_the_rig_expects_then_each_is_found():
    bus = VirtualUsb([HUB, DAQ, ADAPTER, AUDIO])
    findings = found(bus, expect(DAQ, "01a2b3c4 "), expect(ADAPTER, role="mirror"), expect(AUDIO, role="player"))
    assert [one.verdict for one in findings] == [Verdict.FOUND] * 3
    assert [one.remedy for one in findings] == ["", "", ""]
    assert "mirror (USB 0403:6001): 0403:6001 FTDI FT232R USB UART" in findings[1].sentence


def test_given_a_device_that_is_not_there_then_it_is_missing_until_it_is_plugged_in():
    bus = VirtualUsb([DAQ])
    bus.unplug(DAQ)
    (missing,) = found(bus, expect(DAQ))
    assert missing.verdict is Verdict.MISSING
    assert "recorder (USB 3923:7179): it is not plugged in" in missing.sentence
    assert "cable" in missing.remedy
    bus.plug(DAQ)
    assert found(bus, expect(DAQ))[0].verdict is Verdict.FOUND


def test_given_two_of_a_kind_then_the_serial_number_chooses_and_without_one_both_are_told():
    bus = VirtualUsb([ADAPTER, SECOND_ADAPTER])
    (several,) = found(bus, expect(ADAPTER, role="mirror"))
    assert several.verdict is Verdict.SEVERAL
    assert {device.serial_number for device in several.devices} == {"A50285BI", "A7004IXX"}
    assert "serial_number" in several.remedy
    (chosen,) = found(bus, expect(ADAPTER, "A7004IXX", role="mirror"))
    assert (chosen.verdict, chosen.devices[0].serial_number) == (Verdict.FOUND, "A7004IXX")


def test_given_two_of_a_kind_and_one_serial_number_then_the_other_is_left_for_the_other_role():
    bus = VirtualUsb([ADAPTER, SECOND_ADAPTER])
    expected = (expect(ADAPTER, role="mirror"), expect(ADAPTER, "A50285BI", role="vibrometer"))
    mirror, vibrometer = found(bus, *expected)
    assert (mirror.verdict, vibrometer.verdict) == (Verdict.FOUND, Verdict.FOUND)
    assert mirror.expected.role == "mirror"
    assert mirror.devices[0].serial_number == "A7004IXX"


def test_given_another_unit_of_the_same_make_then_its_serial_number_is_told():
    (other,) = found(VirtualUsb([SECOND_ADAPTER]), expect(ADAPTER, "A50285BI", role="mirror"))
    assert other.verdict is Verdict.OTHER_SERIAL
    assert "A7004IXX" in other.sentence
    assert "A50285BI" in other.sentence
    assert "calibrate again" in other.remedy


def test_given_a_unit_swapped_in_the_same_socket_then_the_list_reads_the_new_texts():
    bus = VirtualUsb([ADAPTER])
    assert list_devices(bus)[0].serial_number == "A50285BI"
    bus.unplug(ADAPTER)
    bus.plug(SWAPPED)
    assert list_devices(bus)[0].serial_number == "NEW1"


def test_given_no_permission_then_pyusb_says_langid_and_we_say_which_rule_helps():
    bus = VirtualUsb([DAQ], (NO_PERMISSION,))
    with pytest.raises(ValueError, match="langid"):
        _ = usb.core.find(backend=bus).product
    (denied,) = found(bus, expect(DAQ, "01A2B3C4"))
    assert denied.verdict is Verdict.NO_PERMISSION
    assert "no permission" in denied.sentence
    file = Path(re.search(r"sudo cp (\S+) /etc/udev/rules.d/", denied.remedy).group(1))
    assert 'ATTR{idVendor}=="3923"' in file.read_text(encoding="utf-8")
    assert "udevadm" in denied.remedy


@pytest.mark.parametrize(
    ("device", "number", "verdict"),
    [
        (ADAPTER, "a50285bi", Verdict.FOUND),
        (ADAPTER, "A50285BIA", Verdict.FOUND),  # with the letter of its port, as Windows shows it
        (ADAPTER, "A50285BIX", Verdict.OTHER_SERIAL),
        (DAQ, "01A2B3C4A", Verdict.OTHER_SERIAL),  # only FTDI's have that
    ],
)
def test_given_a_serial_number_as_people_copy_it_then_the_device_is_matched(device, number, verdict):
    (one,) = found(VirtualUsb([device]), expect(device, number))
    assert one.verdict is verdict


def test_given_the_file_of_rules_then_it_has_every_device_that_is_known_and_each_rule_is_one_of_udev():
    rules = [line for line in RULES.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    for rule in rules:
        assert re.fullmatch(r'(?:[A-Z]+(?:\{\w+\})?(?:==|\+?=)"[^"]+"(?:, )?)+', rule)
        assert rule.endswith('MODE="0660", TAG+="uaccess"')
    assert int(RULES.name.split("-")[0]) < 73  # where systemd applies the tag
    for vendor_id, product_id in SERIAL_ADAPTERS:
        assert udev_rule(vendor_id, product_id) in rules
        ports = [rule for rule in rules if rule.startswith('SUBSYSTEM=="tty"') and f"{vendor_id:04x}" in rule]
        assert any(f"{product_id:04x}" in rule for rule in ports)


def test_given_a_device_that_the_file_does_not_have_then_its_own_line_is_told():
    assert udev_rule(0x1234, 0x5678) in permit(0x1234, 0x5678, "linux")


@pytest.mark.parametrize(("platform", "words"), [("win32", "Zadig"), ("darwin", "macOS")])
def test_given_no_permission_on_another_system_then_its_own_remedy_is_told(platform, words):
    (denied,) = found(VirtualUsb([DAQ], (NO_PERMISSION,)), expect(DAQ, "01A2B3C4"), platform=platform)
    assert words in denied.remedy
    assert "serial_number" in denied.remedy


def test_given_no_permission_and_no_serial_number_asked_for_then_the_ids_are_enough_and_advice_is_given():
    (there,) = found(VirtualUsb([DAQ], (NO_PERMISSION,)), expect(DAQ))
    assert there.verdict is Verdict.FOUND
    assert "names cannot be read" in there.sentence
    assert "udev" in there.remedy
    assert there.devices[0].kind is Kind.DAQ


def test_given_a_driver_that_keeps_the_device_then_that_is_told_and_not_a_traceback():
    class Kept(VirtualUsb):
        """As libusb on Windows, where a vendor's driver runs the device."""

        def open_device(self, dev):
            raise NotImplementedError("Operation not supported or unimplemented on this platform")

    (denied,) = found(Kept([DAQ]), expect(DAQ, "01A2B3C4"), platform="win32")
    assert denied.verdict is Verdict.NO_PERMISSION
    assert "its own driver keeps it" in denied.sentence


def test_given_no_libusb_then_it_is_told_what_to_install():
    bus = VirtualUsb([DAQ], (WireFault("usb", "no_backend", "enumerate", at_call=1),))
    with pytest.raises(InstrumentError, match="no libusb was found") as caught:
        list_devices(bus)
    assert "libusb" in caught.value.remedy


def test_given_the_machines_own_libusb_then_the_list_comes_or_says_what_to_install():
    remedy = ""
    try:
        assert all(0 <= device.vendor_id <= 0xFFFF for device in list_devices())
    except InstrumentError as failure:
        remedy = failure.remedy
    assert not remedy or "libusb" in remedy


@pytest.mark.parametrize("operation", ["open", "text", "descriptor"])
def test_given_a_device_unplugged_while_it_is_asked_or_listed_then_the_others_are_there(operation):
    bus = VirtualUsb([DAQ, AUDIO], (WireFault("usb", "unplugged", operation, at_call=1),))
    assert [device.kind for device in list_devices(bus)] == [Kind.AUDIO]


def test_given_a_bus_that_fails_again_and_again_then_the_list_is_given_up_with_a_sentence():
    class Broken(VirtualUsb):
        def enumerate_devices(self):
            raise usb.core.USBError("Input/Output Error", -1, errno.EIO)

    with pytest.raises(InstrumentError, match="Input/Output Error") as caught:
        list_devices(Broken([DAQ]))
    assert "hubs" in caught.value.remedy


def test_given_a_device_that_answers_rubbish_then_it_is_unreadable():
    class Garbled(VirtualUsb):
        def ctrl_transfer(self, dev_handle, *request_and_buffer):
            data = request_and_buffer[4]
            data[:4] = data[:1].__class__("B", b"\x04\x03\x00\xd8")  # half of a surrogate pair
            return 4

    (silent,) = found(Garbled([DAQ]), expect(DAQ, "01A2B3C4"))
    assert silent.verdict is Verdict.UNREADABLE
    assert "does not answer properly" in silent.sentence


@pytest.mark.parametrize("ids", [(0x0403, 0x6001), (0x10C4, 0xEA60), (0x0483, 0xA31E)])
def test_given_a_bridge_of_a_serial_instrument_then_it_is_a_serial_adapter(ids):
    bus = VirtualUsb([VirtualUsbDevice(*ids, "1", port_path=(1, 5))])
    (found,) = list_devices(bus)
    assert found.kind is Kind.SERIAL_ADAPTER
