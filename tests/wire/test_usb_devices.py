"""USB devices that are plugged in, and the reset of one, by the real pyusb on a backend of this file."""

import errno
import re
import time
from array import array
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import usb.core
from usb.backend import IBackend

from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.serial_line import RULES
from wavefocus.drivers.usb import UsbDevice, find_device, list_devices, reset_device

DESCRIPTOR = {"bLength": 18, "bDescriptorType": 1, "bcdUSB": 0x0200, "bDeviceClass": 0, "bDeviceSubClass": 0,
              "bDeviceProtocol": 0, "bMaxPacketSize0": 64, "bcdDevice": 0x0100, "bNumConfigurations": 0, "speed": 3,
              "iManufacturer": 1, "iProduct": 2, "bus": 1, "address": 1}  # fmt: skip


class Bus(IBackend):
    """What pyusb asks of a backend; opening, listing and reset may fail, and a reset device is away for `away_s`."""

    def __init__(self, *devices, away_s=0.0, **failures):
        self.devices, self.away_s, self.failures = devices, away_s, failures
        self.back_s = 0.0
        self.open_handles = 0

    def fail(self, doing):
        if self.failures.get(doing) is not None:
            raise self.failures[doing]

    def enumerate_devices(self):
        self.fail("listing")
        return iter(self.devices if time.monotonic() >= self.back_s else ())

    def get_device_descriptor(self, dev):
        return SimpleNamespace(
            **DESCRIPTOR, idVendor=dev.vendor_id, idProduct=dev.product_id, iSerialNumber=3 if dev.serial_number else 0,
            port_number=dev.port_path[-1], port_numbers=dev.port_path,
        )  # fmt: skip

    def open_device(self, dev):
        if dev is self.devices[0]:
            self.fail("opening")
        self.open_handles += 1
        return dev

    def close_device(self, dev_handle):
        self.open_handles -= 1

    def ctrl_transfer(self, dev_handle, request_type, request, value, index, data, timeout):
        maker, _, product = dev_handle.product.rpartition(" ")
        texts = {1: maker, 2: product, 3: dev_handle.serial_number}
        body = texts[value & 0xFF].encode("utf-16-le") if value & 0xFF else (0x0409).to_bytes(2, "little")
        answer = (bytes((2 + len(body), 3)) + body)[: len(data)]
        data[: len(answer)] = array("B", answer)
        return len(answer)

    def reset_device(self, dev_handle):
        self.back_s = time.monotonic() + self.away_s
        self.fail("reset")


DENIED = usb.core.USBError("Access denied (insufficient permissions)", -3, errno.EACCES)
BUSY = usb.core.USBError("Resource busy", -6, errno.EBUSY)
NOT_FOUND = usb.core.USBError("Entity not found", -5, errno.ENOENT)
DAQ = UsbDevice(0x3923, 0x7179, 1, (1, 2), "National Instruments USB-6211", "01A2B3C4")
ADAPTER = UsbDevice(0x0403, 0x6001, 1, (1, 3), "FTDI FT232R USB UART", "A50285BI")
SECOND_ADAPTER = replace(ADAPTER, serial_number="A7004IXX", port_path=(1, 4))
AUDIO = UsbDevice(0x07FD, 0x0005, 1, (1, 5), "MOTU 24Ao")
CLOSED_DAQ = replace(DAQ, product="", serial_number="", problem="it cannot be opened: Access denied")
RECORDER = ("recorder", 0x3923, 0x7179)


def find(plugged_in, device, serial_number=None):
    return find_device(plugged_in, "recorder", device.vendor_id, device.product_id, serial_number)


@pytest.mark.parametrize("failure", [None, DENIED, NotImplementedError("its own driver runs it")])
def test_each_device_is_listed_with_its_ids_texts_and_place_or_why_it_has_no_texts(failure):
    bus = Bus(DAQ, ADAPTER, AUDIO, opening=failure)
    first, *others = list_devices(bus)
    assert bus.open_handles == 0
    assert others == [ADAPTER, AUDIO]
    assert bool(first.problem) == (failure is not None)
    assert failure is not None or first == DAQ
    text = "3923:7179 National Instruments USB-6211, serial number 01A2B3C4, bus 1 port 1.2"
    assert (str(first) == text) == (failure is None)


@pytest.mark.parametrize(
    ("plugged_in", "device", "number", "found"),
    [
        ([ADAPTER, DAQ], DAQ, None, DAQ),
        ([ADAPTER, SECOND_ADAPTER], ADAPTER, "A7004IXX", SECOND_ADAPTER),
        ([DAQ], DAQ, "01a2b3c4 ", DAQ),
        ([CLOSED_DAQ], DAQ, None, CLOSED_DAQ),  # without a serial number the ids are enough
        ([ADAPTER], DAQ, None, ("not plugged in", "cable")),
        ([ADAPTER, SECOND_ADAPTER], ADAPTER, None, ("A50285BI.*A7004IXX", "serial_number")),
        ([SECOND_ADAPTER], ADAPTER, "A50285BI", ("A7004IXX", "serial_number")),
        ([ADAPTER], ADAPTER, "A50285BIX", ("none with serial number", "serial_number")),
        ([CLOSED_DAQ], DAQ, "01A2B3C4", ("cannot be opened", f"sudo cp {RULES} /etc/udev/rules.d/")),
    ],
)
def test_the_device_of_a_table_is_found_or_those_alike_are_named(plugged_in, device, number, found):
    if isinstance(found, UsbDevice):
        assert find(plugged_in, device, number) == found
        return
    with pytest.raises(InstrumentError, match=found[0]) as caught:
        find(plugged_in, device, number)
    assert caught.value.instrument.startswith("recorder (USB ")
    assert found[1] in caught.value.remedy


def test_the_file_of_rules_has_every_known_device_and_each_rule_is_of_udev():
    rules = [line for line in RULES.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    for rule in rules:
        assert re.fullmatch(r'(?:[A-Z]+(?:\{\w+\})?(?:==|\+?=)"[^"]+"(?:, )?)+', rule)
        assert rule.endswith('MODE="0660", TAG+="uaccess"')
    assert any('ATTR{idVendor}=="3923"' in rule for rule in rules)
    assert int(RULES.name.split("-")[0]) < 73  # where systemd applies the tag
    page = (Path(__file__).parents[2] / "docs" / "reference" / "usb.md").read_text(encoding="utf-8")
    products = set(re.findall(r"0x([0-9A-F]{4})", page.partition("\n\n|")[0])) - {"3923", "0403", "10C4", "0483"}
    assert len(products) == 8
    for product in products:
        assert any(f'ATTR{{idProduct}}=="{product.lower()}"' in rule for rule in rules)
        assert any(rule.startswith('SUBSYSTEM=="tty"') and product.lower() in rule for rule in rules)


def test_given_no_libusb_or_a_bus_that_fails_then_it_says_what_to_do():
    no_backend, broken = usb.core.NoBackendError("No backend available"), usb.core.USBError("Input/Output Error", -1, 5)
    for failure, told in ((no_backend, "no libusb was found.*install libusb"), (broken, "Input/Output Error.*hubs")):
        with pytest.raises(InstrumentError, match=told):
            list_devices(Bus(DAQ, listing=failure))
    remedy = "libusb"
    try:  # the machine's own
        assert all(0 <= device.vendor_id <= 0xFFFF for device in list_devices())
    except InstrumentError as failure:
        remedy = failure.remedy
    assert "libusb" in remedy


@pytest.mark.parametrize(("after", "away_s"), [(None, 0.0), (NOT_FOUND, 0.1)])
def test_given_a_reset_then_the_device_is_waited_for_under_its_old_or_a_new_address(after, away_s):
    bus = Bus(DAQ, ADAPTER, reset=after, away_s=away_s)
    assert reset_device(*RECORDER, backend=bus) == DAQ
    assert time.monotonic() >= bus.back_s
    assert bus.open_handles == 0


@pytest.mark.parametrize(
    ("bus", "kind", "cause", "remedy"),
    [
        (Bus(DAQ, reset=NOT_FOUND, away_s=9.0), InstrumentLostError, "not back after 0.2 s", "plug it in"),
        (Bus(DAQ, reset=BUSY), InstrumentError, "busy", "unplug"),
        (Bus(DAQ, reset=NotImplementedError("not on this platform")), InstrumentError, "platform", "unplug"),
        (Bus(DAQ, opening=DENIED), InstrumentError, "Access denied", "docs/reference/usb.md"),
        (Bus(ADAPTER), InstrumentError, "it is not plugged in", "check its cable"),
        (Bus(DAQ, replace(DAQ, port_path=(1, 7))), InstrumentError, "2 such devices", "serial_number"),
    ],
)
def test_given_a_reset_that_cannot_be_then_it_says_why_and_what_to_do(bus, kind, cause, remedy):
    with pytest.raises(kind, match=cause) as caught:
        reset_device(*RECORDER, backend=bus, within_s=0.2)
    assert remedy in caught.value.remedy
    assert bus.open_handles == 0
