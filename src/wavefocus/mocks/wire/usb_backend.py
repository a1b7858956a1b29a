"""A USB bus with virtual devices, as a backend of pyusb."""

from __future__ import annotations

import errno
import threading
import time
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Literal

from usb.backend import IBackend
from usb.core import NoBackendError, USBError

from wavefocus.mocks.wire.faults import WireFault, WireFaultPlan

ENGLISH = 0x0409
GET_DESCRIPTOR = 0x06
STRING = 0x03
# Constant fields of the descriptors (USB 2.0 specification, section 9.6).
DEVICE = {"bLength": 18, "bDescriptorType": 1, "bcdUSB": 0x0200, "bDeviceSubClass": 0, "bDeviceProtocol": 0,
          "bMaxPacketSize0": 64, "bcdDevice": 0x0100, "bNumConfigurations": 1, "speed": 3}  # fmt: skip
CONFIGURATION = {"bLength": 9, "bDescriptorType": 2, "bConfigurationValue": 1, "iConfiguration": 0,
                 "bmAttributes": 0x80, "bMaxPower": 50}  # fmt: skip
INTERFACE = {"bLength": 9, "bDescriptorType": 4, "bAlternateSetting": 0, "bNumEndpoints": 0, "bInterfaceSubClass": 0,
             "bInterfaceProtocol": 0, "iInterface": 0}  # fmt: skip
# What libusb answers, by the errno that pyusb makes of it.
LIBUSB_ERROR = {errno.EIO: -1, errno.EACCES: -3, errno.ENODEV: -4, errno.ENOENT: -5, errno.EBUSY: -6, errno.EPIPE: -9}


@dataclass(frozen=True, slots=True)
class VirtualUsbDevice:
    """A device that can be plugged into the virtual bus.

    vendor_id, product_id: 0 to 0xFFFF.
    serial_number, manufacturer, product: Its texts; empty where it has none.
    interface_classes: Class of each interface; 1 is audio.
    device_class: 0 leaves it to the interfaces; 9 is a hub.
    bus: Number of its bus.
    port_path: The sockets from the root hub to it.
    after_reset: ``"stays"`` under its address, ``"re-enumerates"`` under a new one after `away_s`, ``"stays away"``,
        ``"refuses"`` with an input/output error, or ``"busy"``.
    away_s: How long it is away where it re-enumerates, >= 0.
    """

    vendor_id: int
    product_id: int
    serial_number: str = ""
    manufacturer: str = ""
    product: str = ""
    interface_classes: tuple[int, ...] = (0xFF,)
    device_class: int = 0
    bus: int = 1
    port_path: tuple[int, ...] = (1,)
    after_reset: Literal["stays", "re-enumerates", "stays away", "refuses", "busy"] = "re-enumerates"
    away_s: float = 0.0


@dataclass(frozen=True, slots=True)
class _Node:
    """A device under one address; a device that is plugged in anew is another node."""

    device: VirtualUsbDevice
    address: int


@dataclass(eq=False, slots=True)
class _Handle:
    node: _Node


class VirtualUsb(IBackend):  # type: ignore[misc]  # pyusb ships no types
    """The bus; give it to pyusb as ``backend``. Safe to use from several threads.

    devices: What is plugged in from the start.
    faults: Those of the role ``"usb"`` strike; their operations are ``"enumerate"``, ``"descriptor"``, ``"open"``,
        ``"text"`` and ``"reset"``. One that is unplugged at an enumeration takes all devices with it, as a hub does.
    """

    def __init__(self, devices: Iterable[VirtualUsbDevice] = (), faults: tuple[WireFault, ...] = ()) -> None:
        self._plan = WireFaultPlan("usb", faults)
        self._lock = threading.RLock()
        self._addresses: dict[int, int] = {}
        self._nodes: list[_Node] = []
        self._away: list[tuple[float, VirtualUsbDevice]] = []
        self._open: set[_Handle] = set()
        for device in devices:
            self.plug(device)

    def plug(self, device: VirtualUsbDevice) -> None:
        """Plug a device in; it gets an address that none has had before on its bus. Twice does no harm."""
        with self._lock:
            self._away = [entry for entry in self._away if entry[1] != device]
            if any(node.device == device for node in self._nodes):
                return
            address = self._addresses.get(device.bus, 0) + 1
            self._addresses[device.bus] = address
            self._nodes.append(_Node(device, address))

    def unplug(self, device: VirtualUsbDevice, seconds: float = 0.0) -> None:
        """Unplug a device, for good or for some seconds; twice does no harm."""
        with self._lock:
            self._nodes = [node for node in self._nodes if node.device != device]
            self._away = [entry for entry in self._away if entry[1] != device]
            if seconds > 0:
                self._away.append((time.monotonic() + seconds, device))

    @property
    def open_handles(self) -> int:
        """Handles that were opened and not closed."""
        with self._lock:
            return len(self._open)

    # -- what pyusb calls ------------------------------------------------------------------------

    def enumerate_devices(self) -> Iterator[_Node]:
        """The nodes of the bus, as they are now."""
        with self._lock:
            self._meet("enumerate", None)
            self._let_return()
            return iter(list(self._nodes))

    def get_device_descriptor(self, dev: _Node) -> SimpleNamespace:
        """The device descriptor, as libusb reads it without opening the device."""
        with self._lock:
            self._meet("descriptor", dev)
            device = self._present(dev).device
        texts = (device.manufacturer, device.product, device.serial_number)
        indices = [number + 1 if text else 0 for number, text in enumerate(texts)]
        return SimpleNamespace(
            **DEVICE,
            bDeviceClass=device.device_class,
            idVendor=device.vendor_id,
            idProduct=device.product_id,
            iManufacturer=indices[0],
            iProduct=indices[1],
            iSerialNumber=indices[2],
            bus=device.bus,
            address=dev.address,
            port_number=device.port_path[-1] if device.port_path else None,
            port_numbers=device.port_path or None,
        )

    def get_configuration_descriptor(self, dev: _Node, config: int) -> SimpleNamespace:
        """The only configuration's descriptor."""
        if config != 0:
            raise IndexError(f"no configuration {config}")
        count = len(self._present(dev).device.interface_classes)
        return SimpleNamespace(**CONFIGURATION, wTotalLength=9 + 9 * count, bNumInterfaces=count, extra_descriptors=[])

    def get_interface_descriptor(self, dev: _Node, intf: int, alt: int, config: int) -> SimpleNamespace:
        """The descriptor of one interface; none has alternate settings."""
        if config != 0 or alt != 0 or not 0 <= intf < len(self._present(dev).device.interface_classes):
            raise IndexError(f"no interface {intf}, alternate setting {alt}, configuration {config}")
        kind = dev.device.interface_classes[intf]
        return SimpleNamespace(**INTERFACE, bInterfaceNumber=intf, bInterfaceClass=kind, extra_descriptors=[])

    def open_device(self, dev: _Node) -> _Handle:
        """Open a device, where that is permitted."""
        with self._lock:
            self._meet("open", dev)
            handle = _Handle(self._present(dev))
            self._open.add(handle)
            return handle

    def close_device(self, dev_handle: _Handle) -> None:
        """Release a handle."""
        with self._lock:
            self._open.discard(dev_handle)

    def ctrl_transfer(
        self,
        dev_handle: _Handle,
        bmRequestType: int,  # noqa: N803  # pyusb's own names
        bRequest: int,  # noqa: N803
        wValue: int,  # noqa: N803
        wIndex: int,  # noqa: N803
        data: array[int],
        timeout: int,
    ) -> int:
        """Answer a question for a text; everything else stalls."""
        with self._lock:
            self._meet("text", dev_handle.node)
            device = self._present(dev_handle.node).device
        texts = {1: device.manufacturer, 2: device.product, 3: device.serial_number}
        index = wValue & 0xFF
        if (bmRequestType, bRequest, wValue >> 8) != (0x80, GET_DESCRIPTOR, STRING) or not (
            index == 0 or texts.get(index)
        ):
            raise _error(errno.EPIPE, "Pipe error")
        body = ENGLISH.to_bytes(2, "little") if index == 0 else texts[index].encode("utf-16-le")
        answer = (bytes((2 + len(body), STRING)) + body)[: len(data)]
        data[: len(answer)] = array("B", answer)
        return len(answer)

    def reset_device(self, dev_handle: _Handle) -> None:
        """Reset a device as its `after_reset` says."""
        with self._lock:
            self._meet("reset", dev_handle.node)
            device = self._present(dev_handle.node).device
            match device.after_reset:
                case "stays":
                    return
                case "refuses":
                    raise _error(errno.EIO, "Input/Output Error")
                case "busy":
                    raise _error(errno.EBUSY, "Resource busy")
                case "re-enumerates":
                    self.unplug(device)
                    self._away.append((time.monotonic() + device.away_s, device))
                case "stays away":
                    self.unplug(device)
            raise _error(errno.ENOENT, "Entity not found")

    # -- faults and comings and goings -------------------------------------------------------------

    def _meet(self, operation: str, node: _Node | None) -> None:
        """Let the faults that are due strike."""
        for fault in self._plan.due(operation):
            if fault.kind == "no_backend":
                raise NoBackendError("No backend available")
            if fault.kind == "unplugged":
                for device in [node.device] if node else [node.device for node in self._nodes]:
                    self.unplug(device, fault.seconds)
            elif node is not None:
                raise _error(errno.EACCES, "Access denied (insufficient permissions)")

    def _let_return(self) -> None:
        now_s = time.monotonic()
        for device in [device for back_s, device in self._away if back_s <= now_s]:
            self.plug(device)

    def _present(self, node: _Node) -> _Node:
        """The node, while its device is plugged in under its address."""
        with self._lock:
            if node not in self._nodes:
                raise _error(errno.ENODEV, "No such device (it may have been disconnected)")
            return node


def _error(number: int, words: str) -> USBError:
    return USBError(words, LIBUSB_ERROR[number], number)
