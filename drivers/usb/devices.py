"""What is plugged in, and the remedies where it cannot be read."""

from __future__ import annotations

import errno
import sys
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from drivers.errors import InstrumentError

RULES_FILE = "/etc/udev/rules.d/70-wavefocus.rules"


def install_libusb(platform: str = sys.platform) -> str:
    """How libusb is installed.

    platform: As ``sys.platform`` names it.
    """
    if platform == "win32":
        return "put libusb-1.0.dll (https://libusb.info, VS2019/MS64/dll) into the folder of python.exe"
    if platform == "darwin":
        return "install libusb: brew install libusb"
    return "install libusb: sudo apt install libusb-1.0-0, or your system's package of that name"


def udev_rule(vendor_id: int, product_id: int) -> str:
    """The line that lets the logged-in user open a device, for a file such as `RULES_FILE`."""
    return (
        f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{vendor_id:04x}", ATTR{{idProduct}}=="{product_id:04x}", '
        'MODE="0660", TAG+="uaccess"'
    )


def permit(vendor_id: int, product_id: int, platform: str = sys.platform) -> str:
    """How a device may be opened.

    vendor_id, product_id: The device's.
    platform: As ``sys.platform`` names it.
    """
    if platform == "win32":
        return (
            "leave serial_number out of its [[usb]] table where its maker's driver runs it (DAQ, audio, serial "
            "adapter); only a device without such a driver gets WinUSB from Zadig (https://zadig.akeo.ie)"
        )
    if platform == "darwin":
        return "leave serial_number out of its [[usb]] table; macOS lets its own driver alone open it"
    return (
        f"write the line {udev_rule(vendor_id, product_id)} into {RULES_FILE}, run "
        "sudo udevadm control --reload-rules && sudo udevadm trigger, and plug the device in again"
    )


NI_VENDOR = 0x3923
SERIAL_ADAPTERS = {
    (0x0403, 0x6001),  # FTDI FT232
    (0x10C4, 0xEA60),  # Silicon Labs CP2102, CP2104: in ASI's Tiger, among others
    (0x10C4, 0xEA70),  # Silicon Labs CP2105, two ports
    (0x10C4, 0xEA71),  # Silicon Labs CP2108, four ports
    (0x0483, 0x5740),  # STMicroelectronics, virtual COM port
    (0x0483, 0xA31E),  # Optotune MR-E-2, on a controller of STMicroelectronics
}
AUDIO_CLASS = 0x01  # https://www.usb.org/defined-class-codes
HUB_CLASS = 0x09
# A device that is unplugged while the list is made ends the list; the next one is complete.
LIST_TRIES = 3
LISTING = "looking for what is plugged in"


class Kind(StrEnum):
    """What a device is to a rig."""

    DAQ = "DAQ"
    SERIAL_ADAPTER = "serial adapter"
    AUDIO = "audio interface"
    HUB = "hub"
    OTHER = "other"


class Problem(StrEnum):
    """Why the texts of a device cannot be read."""

    NONE = ""
    NO_PERMISSION = "no permission to open it"
    HELD_BY_DRIVER = "its own driver keeps it"
    UNREADABLE = "it does not answer properly"


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """A device that is plugged in.

    vendor_id, product_id: Who made it, and what it is, 0 to 0xFFFF.
    kind: From its ids and its interfaces.
    bus, address: Where the system has it now; the address changes when it is plugged in anew.
    port_path: The sockets from the root hub to it; stays when it is plugged in anew; empty where unknown.
    manufacturer, product, serial_number: Its own texts; None where it has none or they cannot be read.
    problem: Why they cannot be read.
    """

    vendor_id: int
    product_id: int
    kind: Kind
    bus: int | None
    address: int | None
    port_path: tuple[int, ...]
    manufacturer: str | None = None
    product: str | None = None
    serial_number: str | None = None
    problem: Problem = Problem.NONE

    def __str__(self) -> str:
        words = " ".join(text for text in (self.manufacturer, self.product) if text) or self.kind
        serial = f", serial number {self.serial_number}" if self.serial_number else ""
        port = f", bus {self.bus} port {'.'.join(map(str, self.port_path))}" if self.port_path else ""
        return f"{self.vendor_id:04x}:{self.product_id:04x} {words}{serial}{port}"


def list_devices(backend: Any = None) -> tuple[UsbDevice, ...]:
    """List what is plugged in. Raises InstrumentError.

    backend: Of pyusb; by default the machine's own libusb.

    Returns tuple of UsbDevice: hubs and foreign devices too.
    """
    return tuple(device for device, _ in list_with_handles(backend))


def list_with_handles(backend: Any = None) -> list[tuple[UsbDevice, Any]]:
    """List what is plugged in, each with pyusb's own ``usb.core.Device``, closed. Raises InstrumentError."""
    try:
        import usb.core
    except ImportError as missing:
        raise InstrumentError("usb", LISTING, f"pyusb is not installed ({missing})", "pip install pyusb") from missing
    for attempt in range(LIST_TRIES):
        try:
            found = list(usb.core.find(find_all=True, backend=backend))
        except usb.core.NoBackendError as missing:
            raise InstrumentError("usb", LISTING, "no libusb was found", install_libusb()) from missing
        except usb.core.USBError as failure:
            if attempt + 1 == LIST_TRIES:
                raise InstrumentError(
                    "usb", LISTING, str(failure), "try again; if it stays, unplug hubs one by one"
                ) from failure
        else:
            break
    listed = ((_described(handle), handle) for handle in found)
    return [(device, handle) for device, handle in listed if device is not None]


def _described(handle: Any) -> UsbDevice | None:
    """What one device says of itself; None when it was unplugged meanwhile."""
    import usb.util

    try:
        texts, problem = _texts(handle)
    except _GoneError:
        return None
    finally:
        usb.util.dispose_resources(handle)
    return UsbDevice(
        vendor_id=int(handle.idVendor),
        product_id=int(handle.idProduct),
        kind=_kind(handle),
        bus=handle.bus,
        address=handle.address,
        port_path=tuple(handle.port_numbers or ()),
        problem=problem,
        **texts,
    )


class _GoneError(Exception):
    """The device was unplugged while it was asked."""


def _texts(handle: Any) -> tuple[dict[str, str | None], Problem]:
    """Manufacturer, product and serial number, as far as they can be read, and why not."""
    import usb.core

    texts: dict[str, str | None] = dict.fromkeys(("manufacturer", "product", "serial_number"))
    try:
        for name in texts:
            # A text that the device does not have costs no traffic and is None.
            texts[name] = (getattr(handle, name) or "").strip("\0 ") or None
    except NotImplementedError:
        return texts, Problem.HELD_BY_DRIVER
    except usb.core.USBError as failure:
        return texts, _problem(failure)
    except ValueError:
        # pyusb says "no langid" for every reason there is; asking again shows which.
        return texts, _why_no_text(handle)
    return texts, Problem.NONE


def _why_no_text(handle: Any) -> Problem:
    import usb.core
    import usb.util

    try:
        usb.util.get_langids(handle)
    except NotImplementedError:
        return Problem.HELD_BY_DRIVER
    except usb.core.USBError as failure:
        return _problem(failure)
    return Problem.UNREADABLE


def _problem(failure: Any) -> Problem:
    if failure.errno == errno.EACCES:
        return Problem.NO_PERMISSION
    if failure.errno in (errno.ENOSYS, errno.EBUSY):
        return Problem.HELD_BY_DRIVER
    if failure.errno in (errno.ENODEV, errno.ENOENT):
        raise _GoneError from failure
    return Problem.UNREADABLE


def _kind(handle: Any) -> Kind:
    if handle.idVendor == NI_VENDOR:
        return Kind.DAQ
    if (handle.idVendor, handle.idProduct) in SERIAL_ADAPTERS:
        return Kind.SERIAL_ADAPTER
    if handle.bDeviceClass == HUB_CLASS:
        return Kind.HUB
    return Kind.AUDIO if AUDIO_CLASS in _interface_classes(handle) else Kind.OTHER


def _interface_classes(handle: Any) -> set[int]:
    """Classes of all interfaces; fewer where the system does not report them."""
    import usb.core

    classes: set[int] = set()
    try:
        for configuration in handle:
            classes.update(int(interface.bInterfaceClass) for interface in configuration)
    except (usb.core.USBError, NotImplementedError):
        return classes
    return classes
