"""USB devices: a list of those plugged in, and a reset of one that the rig file names.

A reset switches a device off and on by its port. It needs a person's explicit order.
"""

from __future__ import annotations

import errno
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, MissingPackageError
from wavefocus.drivers.protocols import Clock, WallClock
from wavefocus.drivers.serial_line import LETTERS, RULES, RULES_FOLDER

FTDI_VENDOR = 0x0403
# A device that is unplugged while the list is made ends the list; the next one is complete.
LIST_TRIES = 3
LISTING, RESETTING = "listing USB devices", "resetting it over USB"
NO_PERMISSION = "no permission to open it"
BY_HAND = "unplug it, wait a moment and plug it in again"
# DAQ boxes and audio interfaces load firmware after a reset.
BACK_WITHIN_S = 15.0
LOOK_EVERY_S = 0.1


def install_libusb(platform: str = sys.platform) -> str:
    """How libusb is installed on a platform, as ``sys.platform`` names it."""
    if platform == "win32":
        return "put libusb-1.0.dll (https://libusb.info, VS2019/MS64/dll) into the folder of python.exe"
    if platform == "darwin":
        return "install libusb: brew install libusb"
    return "install libusb: sudo apt install libusb-1.0-0, or your system's package of that name"


def permit(vendor_id: int, product_id: int, platform: str = sys.platform) -> str:
    """How a device may be opened on a platform, as ``sys.platform`` names it."""
    if platform == "win32":
        return (
            "leave serial_number out of its [[usb]] table where its maker's driver runs it (DAQ, audio, serial "
            "adapter); only a device without such a driver gets WinUSB from Zadig (https://zadig.akeo.ie)"
        )
    if platform == "darwin":
        return "leave serial_number out of its [[usb]] table; only macOS's own driver may open it"
    ids = f'ATTR{{idVendor}}=="{vendor_id:04x}", ATTR{{idProduct}}=="{product_id:04x}"'
    rule = f'SUBSYSTEM=="usb", {ids}, MODE="0660", TAG+="uaccess"'
    return (
        f"sudo cp {RULES} {RULES_FOLDER} (a device that the file lacks needs the line {rule} there); then sudo udevadm "
        "control --reload-rules && sudo udevadm trigger, and plug the device in again"
    )


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """A device that is plugged in.

    vendor_id, product_id: 0 to 0xFFFF.
    bus, address: Where the system has it; the address changes when it is plugged in again.
    port_path: The sockets from the root hub to it; empty where unknown.
    manufacturer, product, serial_number: Its own texts; None where it has none or they cannot be read.
    problem: Why they cannot be read; empty where they can.
    """

    vendor_id: int
    product_id: int
    bus: int | None
    address: int | None
    port_path: tuple[int, ...]
    manufacturer: str | None = None
    product: str | None = None
    serial_number: str | None = None
    problem: str = ""

    def __str__(self) -> str:
        parts = [f"{self.vendor_id:04x}:{self.product_id:04x}"]
        parts += [text for text in (self.manufacturer, self.product) if text]
        serial = f", serial number {self.serial_number}" if self.serial_number else ""
        port = f", bus {self.bus} port {'.'.join(map(str, self.port_path))}" if self.port_path else ""
        problem = f" (its names cannot be read: {self.problem})" if self.problem else ""
        return f"{' '.join(parts)}{serial}{port}{problem}"


def list_devices(backend: Any = None) -> list[UsbDevice]:
    """List what is plugged in, hubs included; `backend` is pyusb's, by default the machine's libusb.

    Raises InstrumentError: pyusb or libusb is missing, or the bus cannot be read.
    """
    return [device for device, _ in _list_with_handles(backend)]


def _list_with_handles(backend: Any) -> list[tuple[UsbDevice, Any]]:
    """The devices, each with pyusb's own ``usb.core.Device``, closed."""
    try:
        import usb.core
    except ImportError as missing:
        raise MissingPackageError(
            "usb", LISTING, f"pyusb is not installed ({missing})", "pip install pyusb"
        ) from missing
    for left in reversed(range(LIST_TRIES)):
        try:
            handles = list(usb.core.find(find_all=True, backend=backend))
            break
        except usb.core.NoBackendError as missing:
            raise InstrumentError("usb", LISTING, "no libusb was found", install_libusb()) from missing
        except usb.core.USBError as failure:
            if not left:
                remedy = "try again; if it stays, unplug hubs one by one"
                raise InstrumentError("usb", LISTING, str(failure), remedy) from failure
    described = ((_describe(handle), handle) for handle in handles)
    return [(device, handle) for device, handle in described if device is not None]


def _describe(handle: Any) -> UsbDevice | None:
    """What one device says of itself; None when it was unplugged meanwhile."""
    import usb.core
    import usb.util

    texts: dict[str, str | None] = dict.fromkeys(("manufacturer", "product", "serial_number"))
    problem = ""
    try:
        for name in texts:
            texts[name] = (getattr(handle, name) or "").strip("\0 ") or None
    except (NotImplementedError, usb.core.USBError, ValueError) as failure:
        number = _error_number(handle, failure)
        if number in (errno.ENODEV, errno.ENOENT):
            return None
        problem = NO_PERMISSION if number == errno.EACCES else "it does not answer properly"
        if number in (errno.ENOSYS, errno.EBUSY):
            problem = "its own driver keeps it"
    finally:
        usb.util.dispose_resources(handle)
    return UsbDevice(
        int(handle.idVendor),
        int(handle.idProduct),
        handle.bus,
        handle.address,
        tuple(handle.port_numbers or ()),
        **texts,
        problem=problem,
    )


def _error_number(handle: Any, failure: Exception) -> int:
    """The system's number of a failure, 0 where it has none."""
    import usb.core
    import usb.util

    if isinstance(failure, ValueError):
        # pyusb says "no langid" for every reason there is; asking again shows which.
        try:
            usb.util.get_langids(handle)
        except (NotImplementedError, usb.core.USBError) as reason:
            failure = reason
    return errno.ENOSYS if isinstance(failure, NotImplementedError) else getattr(failure, "errno", None) or 0


def find_device(
    devices: Sequence[UsbDevice], role: str, vendor_id: int, product_id: int, serial_number: str | None = None
) -> UsbDevice:
    """The one device of a ``[[usb]]`` table among those that are plugged in; `serial_number` None: any.

    Raises InstrumentError: none of them is it, or more than one.
    """
    name = f"{role} (USB {vendor_id:04x}:{product_id:04x})"
    alike = [device for device in devices if (device.vendor_id, device.product_id) == (vendor_id, product_id)]
    chosen = [device for device in alike if serial_number is None or _has_number(device, serial_number)]
    if len(chosen) == 1:
        return chosen[0]
    listed = "; ".join(map(str, chosen or alike))
    if chosen:
        remedy = "write the serial_number of the right one into its [[usb]] table, or unplug the other"
        raise InstrumentError(name, LISTING, f"{len(chosen)} such devices are plugged in: {listed}", remedy)
    if not alike:
        remedy = "check its cable, its power and the hub, and the vendor_id and product_id in its [[usb]] table"
        raise InstrumentError(name, LISTING, "it is not plugged in", remedy)
    remedy = "plug in the rig's own device, or write the new one's serial_number into its [[usb]] table"
    if any(device.problem for device in alike):
        remedy = permit(vendor_id, product_id)
    raise InstrumentError(name, LISTING, f"none with serial number {serial_number} is plugged in: {listed}", remedy)


def _has_number(device: UsbDevice, wanted: str) -> bool:
    """Whether a device has a serial number as people copy it: from a label, or from Windows with FTDI's letter."""
    own, wanted = (device.serial_number or "").casefold(), wanted.strip().casefold()
    ftdi = device.vendor_id == FTDI_VENDOR and wanted[-1:].upper() in LETTERS
    return own != "" and (own == wanted or (ftdi and own == wanted[:-1]))


def reset_device(
    role: str,
    vendor_id: int,
    product_id: int,
    serial_number: str | None = None,
    *,
    backend: Any = None,
    clock: Clock | None = None,
) -> UsbDevice:
    """Reset the device of a ``[[usb]]`` table and wait until it is back.

    Programs that use the device must have released it. Raises InstrumentError; InstrumentLostError: it does not come
    back.

    backend: Of pyusb; by default the machine's libusb.
    clock: By default the wall's.

    Returns the device as it is now; its address may be another.
    """
    name = f"{role} (USB {vendor_id:04x}:{product_id:04x})"
    listed = _list_with_handles(backend)
    import usb.core
    import usb.util

    before = find_device([device for device, _ in listed], role, vendor_id, product_id, serial_number)
    handle = next(handle for device, handle in listed if device is before)
    try:
        handle.reset()
    except (NotImplementedError, usb.core.USBError) as failure:
        cause, remedy = {
            errno.EACCES: (NO_PERMISSION, permit(vendor_id, product_id)),
            errno.ENOSYS: ("this system cannot do it", BY_HAND),
            errno.EBUSY: ("another program holds it", "close that program, then reset again"),
        }.get(number := _error_number(handle, failure), (str(failure), BY_HAND))
        # Under a new address it is not found, which is a success.
        if number not in (errno.ENOENT, errno.ENODEV):
            raise InstrumentError(name, RESETTING, cause, remedy) from failure
    finally:
        usb.util.dispose_resources(handle)
    clock = clock or WallClock()
    until_s = clock.now_s() + BACK_WITHIN_S
    while True:
        for device in list_devices(backend):  # afresh: pyusb's objects keep old addresses and texts
            if _is_back(device, before):
                return device
        if clock.now_s() >= until_s:
            raise InstrumentLostError(name, RESETTING, f"it is not back after {BACK_WITHIN_S:g} s", BY_HAND)
        clock.sleep(LOOK_EVERY_S)


def _is_back(device: UsbDevice, before: UsbDevice) -> bool:
    """Whether this is the device from before, and answers as well as it did then."""
    if (device.vendor_id, device.product_id) != (before.vendor_id, before.product_id):
        return False
    if device.problem and not before.problem:
        return False
    if before.serial_number is not None:
        return device.serial_number == before.serial_number
    return device.port_path == before.port_path
