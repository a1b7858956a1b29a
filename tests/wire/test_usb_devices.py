"""What is plugged in, seen by the real pyusb on a virtual bus."""

from __future__ import annotations

import errno
import re
from pathlib import Path

import pytest
import usb.core

from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.serial_line import RULES
from wavefocus.drivers.usb import UsbDevice, find_device, list_devices, permit
from wavefocus.mocks.wire.faults import WireFault
from wavefocus.mocks.wire.usb_backend import VirtualUsb, VirtualUsbDevice

DAQ = VirtualUsbDevice(0x3923, 0x7179, "01A2B3C4", "National Instruments", "USB-6211", port_path=(1, 2))
ADAPTER = VirtualUsbDevice(0x0403, 0x6001, "A50285BI", "FTDI", "FT232R USB UART", port_path=(1, 3))
SECOND_ADAPTER = VirtualUsbDevice(0x0403, 0x6001, "A7004IXX", "FTDI", "FT232R USB UART", port_path=(1, 4))
AUDIO = VirtualUsbDevice(0x07FD, 0x0005, "", "MOTU", "24Ao", interface_classes=(0x01, 0x01, 0x03), bus=2)
HUB = VirtualUsbDevice(0x05E3, 0x0610, product="Hub", interface_classes=(9,), device_class=9, port_path=())

SWAPPED = VirtualUsbDevice(0x0403, 0x6001, "NEW1", port_path=(1, 3))
NO_PERMISSION = WireFault("usb", "no_permission", "open", at_call=1, count=1000)


def find(bus: VirtualUsb, device: VirtualUsbDevice, serial_number: str | None = None) -> UsbDevice:
    return find_device(list_devices(bus), "recorder", device.vendor_id, device.product_id, serial_number)


def test_given_a_bus_then_each_device_is_listed_with_its_ids_texts_and_place():
    bus = VirtualUsb([HUB, DAQ, ADAPTER, AUDIO])
    hub, daq, adapter, audio = list_devices(bus)
    assert bus.open_handles == 0
    assert (daq.vendor_id, daq.product_id) == (0x3923, 0x7179)
    assert (daq.manufacturer, daq.product, daq.serial_number) == ("National Instruments", "USB-6211", "01A2B3C4")
    assert (daq.bus, daq.address, daq.port_path) == (1, 2, (1, 2))
    assert (audio.bus, audio.serial_number) == (2, None)
    assert not any(device.problem for device in (hub, daq, adapter, audio))
    assert str(daq) == "3923:7179 National Instruments USB-6211, serial number 01A2B3C4, bus 1 port 1.2"


@pytest.mark.parametrize(
    ("plugged_in", "device", "number", "port_path"),
    [
        ([HUB, DAQ, ADAPTER], DAQ, None, (1, 2)),
        ([ADAPTER, SECOND_ADAPTER], ADAPTER, "A7004IXX", (1, 4)),
        ([DAQ], DAQ, "01a2b3c4 ", (1, 2)),
        ([ADAPTER], ADAPTER, "a50285bi", (1, 3)),
        ([ADAPTER], ADAPTER, "A50285BIA", (1, 3)),  # with the letter of its port, as Windows shows it
    ],
)
def test_given_a_table_of_the_rig_then_its_device_is_found(plugged_in, device, number, port_path):
    assert find(VirtualUsb(plugged_in), device, number).port_path == port_path


@pytest.mark.parametrize(
    ("plugged_in", "device", "number", "cause", "remedy"),
    [
        ([ADAPTER], DAQ, None, "not plugged in", "cable"),
        ([ADAPTER, SECOND_ADAPTER], ADAPTER, None, "A50285BI.*A7004IXX", "serial_number"),
        ([SECOND_ADAPTER], ADAPTER, "A50285BI", "A50285BI.*A7004IXX", "serial_number"),
        ([ADAPTER], ADAPTER, "A50285BIX", "none with serial number", "serial_number"),
        ([DAQ], DAQ, "01A2B3C4A", "none with serial number", "serial_number"),  # only FTDI's have that letter
    ],
)
def test_given_no_such_device_or_several_then_those_alike_are_named(plugged_in, device, number, cause, remedy):
    with pytest.raises(InstrumentError, match=cause) as caught:
        find(VirtualUsb(plugged_in), device, number)
    assert caught.value.instrument.startswith("recorder (USB ")
    assert remedy in caught.value.remedy


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
    with pytest.raises(InstrumentError, match="no permission") as caught:
        find(bus, DAQ, "01A2B3C4")
    file = Path(re.search(r"sudo cp (\S+) /etc/udev/rules.d/", permit(0x3923, 0x7179, "linux")).group(1))
    assert 'ATTR{idVendor}=="3923"' in file.read_text(encoding="utf-8")
    assert caught.value.remedy == permit(0x3923, 0x7179)
    assert find(bus, DAQ).problem  # without a serial number the ids are enough


def test_given_the_file_of_rules_then_it_has_every_device_that_is_known_and_each_rule_is_one_of_udev():
    rules = [line for line in RULES.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    for rule in rules:
        assert re.fullmatch(r'(?:[A-Z]+(?:\{\w+\})?(?:==|\+?=)"[^"]+"(?:, )?)+', rule)
        assert rule.endswith('MODE="0660", TAG+="uaccess"')
    assert int(RULES.name.split("-")[0]) < 73  # where systemd applies the tag
    page = (Path(__file__).parents[2] / "docs" / "reference" / "usb.md").read_text(encoding="utf-8")
    products = set(re.findall(r"0x([0-9A-F]{4})", page.partition("\n\n|")[0])) - {"3923", "0403", "10C4", "0483"}
    assert len(products) == 8
    for product in products:
        assert any(f'ATTR{{idProduct}}=="{product.lower()}"' in rule for rule in rules)
        assert any(rule.startswith('SUBSYSTEM=="tty"') and product.lower() in rule for rule in rules)


@pytest.mark.parametrize(
    ("platform", "words"), [("linux", 'ATTR{idProduct}=="5678"'), ("win32", "Zadig"), ("darwin", "macOS")]
)
def test_given_a_system_then_permission_is_given_in_its_own_way(platform, words):
    assert words in permit(0x1234, 0x5678, platform)
    assert platform == "linux" or "serial_number" in permit(0x1234, 0x5678, platform)


def test_given_a_driver_that_keeps_the_device_then_that_is_named():
    class Kept(VirtualUsb):
        """As libusb on Windows, where a vendor's driver runs the device."""

        def open_device(self, dev):
            raise NotImplementedError("Operation not supported or unimplemented on this platform")

    (device,) = list_devices(Kept([DAQ]))
    assert device.problem == "its own driver keeps it"


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
    assert [device.product for device in list_devices(bus)] == ["24Ao"]


def test_given_a_bus_that_fails_again_and_again_then_the_list_is_given_up_with_a_sentence():
    class Broken(VirtualUsb):
        def enumerate_devices(self):
            raise usb.core.USBError("Input/Output Error", -1, errno.EIO)

    with pytest.raises(InstrumentError, match="Input/Output Error") as caught:
        list_devices(Broken([DAQ]))
    assert "hubs" in caught.value.remedy


def test_given_a_device_that_answers_rubbish_then_its_texts_are_left_out():
    class Garbled(VirtualUsb):
        def ctrl_transfer(self, dev_handle, *request_and_buffer):
            data = request_and_buffer[4]
            data[:4] = data[:1].__class__("B", b"\x04\x03\x00\xd8")  # half of a surrogate pair
            return 4

    (device,) = list_devices(Garbled([DAQ]))
    assert device.problem == "it does not answer properly"
