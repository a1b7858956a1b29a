"""USB devices: a list of those plugged in, and a reset of one that the rig file names.

A reset switches a device off and on by its port. It needs a person's explicit order.
"""

import errno
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, MissingPackageError
from wavefocus.drivers.serial_line import RULES, RULES_FOLDER

_LISTING, _RESETTING = "listing USB devices", "resetting it over USB"
_BY_HAND = "unplug it, wait a moment and plug it in again"
_BACK_WITHIN_S = 15.0
"""DAQ boxes and audio interfaces load firmware after a reset."""
_PERMIT = (
    f"on Linux: sudo cp {RULES} {RULES_FOLDER} && sudo udevadm control --reload-rules && sudo udevadm trigger, and "
    "plug the device in again; a device that the file lacks, and other systems: docs/reference/usb.md"
)


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """A device that is plugged in.

    vendor_id, product_id: 0 to 0xFFFF.
    bus: Number of its bus.
    port_path: The sockets from the root hub to it; empty where unknown.
    product, serial_number: Its own texts, the first with its maker; empty where it has none or they cannot be read.
    problem: Why they cannot be read; empty where they can.
    """

    vendor_id: int
    product_id: int
    bus: int | None
    port_path: tuple[int, ...]
    product: str = ""
    serial_number: str = ""
    problem: str = ""

    def __str__(self) -> str:
        name = f"{self.vendor_id:04x}:{self.product_id:04x} {self.product}".rstrip()
        serial = f", serial number {self.serial_number}" if self.serial_number else ""
        port = f", bus {self.bus} port {'.'.join(map(str, self.port_path))}" if self.port_path else ""
        problem = f" (its names cannot be read: {self.problem})" if self.problem else ""
        return f"{name}{serial}{port}{problem}"


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
        cause = f"pyusb is not installed ({missing})"
        raise MissingPackageError("usb", _LISTING, cause, "pip install pyusb") from missing
    try:
        handles = list(usb.core.find(find_all=True, backend=backend))
    except usb.core.NoBackendError as missing:
        remedy = (
            "install libusb (https://libusb.info): apt install libusb-1.0-0, brew install libusb, or libusb-1.0.dll"
        )
        raise InstrumentError("usb", _LISTING, "no libusb was found", remedy) from missing
    except usb.core.USBError as failure:
        remedy = "try again; if it stays, unplug hubs one by one"
        raise InstrumentError("usb", _LISTING, str(failure), remedy) from failure
    return [(_describe(handle), handle) for handle in handles]


def _describe(handle: Any) -> UsbDevice:
    """What one device says of itself."""
    import usb.core
    import usb.util

    texts, problem = ["", "", ""], ""
    try:
        names = ("manufacturer", "product", "serial_number")
        texts = [(getattr(handle, name) or "").strip("\0 ") for name in names]
    except (NotImplementedError, usb.core.USBError, ValueError) as failure:
        problem = f"it cannot be opened: {failure}"
    finally:
        usb.util.dispose_resources(handle)
    port_path = tuple(handle.port_numbers or ())
    product = " ".join(text for text in texts[:2] if text)
    return UsbDevice(int(handle.idVendor), int(handle.idProduct), handle.bus, port_path, product, texts[2], problem)


def find_device(
    devices: Sequence[UsbDevice], role: str, vendor_id: int, product_id: int, serial_number: str | None = None
) -> UsbDevice:
    """The one device of a ``[[usb]]`` table among those that are plugged in; `serial_number` None: any.

    Raises InstrumentError: none of them is it, or more than one.
    """
    name = f"{role} (USB {vendor_id:04x}:{product_id:04x})"
    alike = [device for device in devices if (device.vendor_id, device.product_id) == (vendor_id, product_id)]
    wanted = (serial_number or "").strip().casefold()
    chosen = [device for device in alike if serial_number is None or device.serial_number.casefold() == wanted]
    if len(chosen) == 1:
        return chosen[0]
    listed = "; ".join(map(str, chosen or alike))
    if chosen:
        remedy = "write the serial_number of the right one into its [[usb]] table, or unplug the other"
        raise InstrumentError(name, _LISTING, f"{len(chosen)} such devices are plugged in: {listed}", remedy)
    if not alike:
        remedy = "check its cable, its power and the hub, and the vendor_id and product_id in its [[usb]] table"
        raise InstrumentError(name, _LISTING, "it is not plugged in", remedy)
    remedy = "plug in the rig's own device, or write the new one's serial_number into its [[usb]] table"
    if any(device.problem for device in alike):
        remedy = _PERMIT
    raise InstrumentError(name, _LISTING, f"none with serial number {serial_number} is plugged in: {listed}", remedy)


def reset_device(
    role: str, vendor_id: int, product_id: int, serial_number: str | None = None, *, backend: Any = None,
    within_s: float = _BACK_WITHIN_S,
) -> UsbDevice:  # fmt: skip
    """Reset the device of a ``[[usb]]`` table and wait until it is back.

    Programs that use the device must have released it. Raises InstrumentError; InstrumentLostError: it does not come
    back in `within_s`, in seconds.
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
        number = getattr(failure, "errno", None)
        # Under a new address it is not found, which is a success.
        if number not in (errno.ENOENT, errno.ENODEV):
            remedy = _PERMIT if number == errno.EACCES else _BY_HAND
            raise InstrumentError(name, _RESETTING, str(failure), remedy) from failure
    finally:
        usb.util.dispose_resources(handle)
    until_s = time.monotonic() + within_s
    while time.monotonic() < until_s:
        with suppress(InstrumentError):  # the list breaks off while a device comes or goes
            if before in list_devices(backend):  # its address may be another, which is not compared
                return before
        time.sleep(0.1)
    raise InstrumentLostError(name, _RESETTING, f"it is not back after {within_s:g} s", _BY_HAND)
