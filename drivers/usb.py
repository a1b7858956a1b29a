"""USB devices: what is plugged in, whether it is what the rig expects, and a reset.

A reset switches a device off and on by its port. It is a person's explicit choice, never a routine.
"""

from __future__ import annotations

import errno
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, MissingPackageError
from wavefocus.drivers.protocols import Clock, WallClock
from wavefocus.drivers.serial_line import LETTERS, RULES, RULES_FOLDER


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
    """The line that lets the logged-in user open a device, for a file such as `RULES`."""
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
    if vendor_id == NI_VENDOR or (vendor_id, product_id) in SERIAL_ADAPTERS:
        first = f"sudo cp {RULES} {RULES_FOLDER}"
    else:
        first = f"write the line {udev_rule(vendor_id, product_id)} into {RULES_FOLDER}{RULES.name}"
    return f"{first}; then sudo udevadm control --reload-rules && sudo udevadm trigger, and plug the device in again"


NI_VENDOR = 0x3923
FTDI_VENDOR = 0x0403
SERIAL_ADAPTERS = {
    (0x0403, 0x6001),  # FTDI FT232
    (0x0403, 0x6010),  # FTDI FT2232, two ports
    (0x0403, 0x6015),  # FTDI FT-X
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
        raise MissingPackageError(
            "usb", LISTING, f"pyusb is not installed ({missing})", "pip install pyusb"
        ) from missing
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
    import usb.core
    import usb.util

    texts: dict[str, str | None] = dict.fromkeys(("manufacturer", "product", "serial_number"))
    problem: Problem | None = Problem.NONE
    try:
        for name in texts:
            # A text that the device does not have costs no traffic and is None.
            texts[name] = (getattr(handle, name) or "").strip("\0 ") or None
    except (NotImplementedError, usb.core.USBError, ValueError) as failure:
        problem = _problem(handle, failure)
    finally:
        usb.util.dispose_resources(handle)
    if problem is None:
        return None
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


def _problem(handle: Any, failure: Exception) -> Problem | None:
    """Why the texts of a device cannot be read; None when it was unplugged meanwhile."""
    import usb.core
    import usb.util

    if isinstance(failure, ValueError):
        # pyusb says "no langid" for every reason there is; asking again shows which.
        try:
            usb.util.get_langids(handle)
        except (NotImplementedError, usb.core.USBError) as reason:
            failure = reason
    number = getattr(failure, "errno", None)
    if number in (errno.ENODEV, errno.ENOENT):
        return None
    if number == errno.EACCES:
        return Problem.NO_PERMISSION
    if isinstance(failure, NotImplementedError) or number in (errno.ENOSYS, errno.EBUSY):
        return Problem.HELD_BY_DRIVER
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


class Verdict(StrEnum):
    """How an expected device was found."""

    FOUND = "found"
    MISSING = "missing"
    SEVERAL = "several"
    OTHER_SERIAL = "another serial number"
    NO_PERMISSION = "no permission"
    UNREADABLE = "unreadable"


@dataclass(frozen=True, slots=True)
class ExpectedUsbDevice:
    """A device that should be plugged in: a ``[[usb]]`` table of the rig.

    role: Whose device it is: ``"mirror"``, ``"recorder"``, ``"player"`` or ``"vibrometer"``.
    vendor_id, product_id: 0 to 0xFFFF.
    serial_number: Needed where two devices have the same ids.
    """

    role: str
    vendor_id: int
    product_id: int
    serial_number: str | None = None

    def __str__(self) -> str:
        serial = f" with the serial number {self.serial_number}" if self.serial_number else ""
        return f"{self.role} (USB {self.vendor_id:04x}:{self.product_id:04x}{serial})"


@dataclass(frozen=True, slots=True)
class Finding:
    """What became of one expectation.

    expected: What was looked for.
    verdict: Whether it is there.
    devices: The one that was found, or those that come into question.
    sentence: For people.
    remedy: What to do; empty when all is well. A device that was found may still carry advice.
    """

    expected: ExpectedUsbDevice
    verdict: Verdict
    devices: tuple[UsbDevice, ...]
    sentence: str
    remedy: str = ""


def match_devices(
    expected: Sequence[ExpectedUsbDevice], plugged_in: Sequence[UsbDevice], platform: str = sys.platform
) -> tuple[Finding, ...]:
    """Look for each expected device among those that are plugged in.

    Expectations with a serial number choose first; of two equal devices the other is left for one without.

    expected: The rig's.
    plugged_in: From `list_devices`.
    platform: For the remedies, as ``sys.platform`` names it.

    Returns tuple of Finding: one per expectation, in their order.
    """
    left = list(plugged_in)
    findings: dict[int, Finding] = {}
    for index in sorted(range(len(expected)), key=lambda index: expected[index].serial_number is None):
        one = expected[index]
        candidates = [
            device for device in left if (device.vendor_id, device.product_id) == (one.vendor_id, one.product_id)
        ]
        findings[index] = _judge(one, candidates, platform)
        if findings[index].verdict is Verdict.FOUND:
            left.remove(findings[index].devices[0])
    return tuple(findings[index] for index in range(len(expected)))


def _judge(expected: ExpectedUsbDevice, candidates: list[UsbDevice], platform: str) -> Finding:
    """What became of an expectation, from the devices with its ids."""

    def finding(verdict: Verdict, devices: Sequence[UsbDevice], sentence: str, remedy: str = "") -> Finding:
        return Finding(expected, verdict, tuple(devices), f"{expected}: {sentence}", remedy)

    if not candidates:
        remedy = "check its cable, its power and the hub, and the vendor_id and product_id in its [[usb]] table"
        return finding(Verdict.MISSING, (), "it is not plugged in", remedy)
    wanted = expected.serial_number
    same = [device for device in candidates if wanted is None or _has_number(device, wanted)]
    if len(same) == 1:
        return finding(Verdict.FOUND, same, *_as_found(same[0], platform))
    if same:
        listed = "; ".join(str(device) for device in same)
        if wanted is None:
            sentence = f"{len(same)} such devices are plugged in: {listed}"
            remedy = "write the serial_number of the right one into its [[usb]] table"
        else:
            sentence = f"{len(same)} devices claim that serial number: {listed}"
            remedy = "unplug the one that does not belong to the rig"
        return finding(Verdict.SEVERAL, same, sentence, remedy)
    unreadable = "its serial number cannot be read: {}"
    if closed := [one for one in candidates if one.problem in (Problem.NO_PERMISSION, Problem.HELD_BY_DRIVER)]:
        remedy = permit(expected.vendor_id, expected.product_id, platform)
        return finding(Verdict.NO_PERMISSION, closed, unreadable.format(closed[0].problem), remedy)
    if silent := [device for device in candidates if device.problem is Problem.UNREADABLE]:
        remedy = "unplug it and plug it in again, without a hub if there is one"
        return finding(Verdict.UNREADABLE, silent, unreadable.format(silent[0].problem), remedy)
    serials = ", ".join(device.serial_number or "none" for device in candidates)
    return finding(
        Verdict.OTHER_SERIAL,
        candidates,
        f"plugged in is another one, serial number {serials}",
        "plug in the rig's own device, or write the new one's serial_number into its [[usb]] table and calibrate again",
    )


def _as_found(device: UsbDevice, platform: str) -> tuple[str, str]:
    """Sentence and advice about a device that was found."""
    if device.problem is Problem.NONE:
        return str(device), ""
    advice = ""
    if device.problem is Problem.NO_PERMISSION:
        advice = f"only a USB reset needs it; to permit it: {permit(device.vendor_id, device.product_id, platform)}"
    return f"{device}; its names cannot be read: {device.problem}", advice


def _has_number(device: UsbDevice, wanted: str) -> bool:
    """Whether a device has a serial number as people copy it: from a label, or from Windows with FTDI's letter."""
    found, wanted = (device.serial_number or "").casefold(), wanted.strip().casefold()
    ftdi = device.vendor_id == FTDI_VENDOR and wanted[-1:].upper() in LETTERS
    return found != "" and (found == wanted or (ftdi and found == wanted[:-1]))


RESETTING = "resetting it over USB"
# DAQ boxes and audio interfaces load firmware after a reset; slower ones are left to the person's patience.
COMES_BACK_S = 15.0
LOOKED_FOR_EVERY_S = 0.1
BY_HAND = "unplug it, wait a moment and plug it in again"


def reset_device(
    role: str,
    expected: Sequence[ExpectedUsbDevice],
    *,
    backend: Any = None,
    comes_back_s: float = COMES_BACK_S,
    clock: Clock | None = None,
) -> UsbDevice:
    """Reset the device of one role and wait until it is back.

    Programs that use the device must have released it. Try a fresh connection first, and the
    maker's own reset where there is one; this comes last. Raises InstrumentLostError or InstrumentError.

    role: Whose device.
    expected: The rig's; one of them has the role.
    backend: Of pyusb; by default the machine's own libusb.
    comes_back_s: How long the device is waited for.
    clock: By default the wall's.

    Returns UsbDevice: the device as it is now; its address may be a new one.
    """
    clock = clock or WallClock()
    wanted = next((one for one in expected if one.role == role), None)
    if wanted is None:
        raise InstrumentError(role, RESETTING, "the rig says nothing of its USB device", "write a [[usb]] table for it")
    listed = list_with_handles(backend)
    finding = next(one for one in match_devices(expected, [device for device, _ in listed]) if one.expected is wanted)
    if finding.verdict is not Verdict.FOUND:
        raise InstrumentError(str(wanted), RESETTING, finding.sentence.partition(": ")[2], finding.remedy)
    before = finding.devices[0]
    handle = next(handle for device, handle in listed if device is before)
    _reset(handle, wanted)
    return _found_again(before, wanted, backend, comes_back_s, clock)


def _reset(handle: Any, wanted: ExpectedUsbDevice) -> None:
    import usb.core
    import usb.util

    def failed(cause: str, remedy: str) -> InstrumentError:
        return InstrumentError(str(wanted), RESETTING, cause, remedy)

    try:
        handle.reset()
    except NotImplementedError as failure:
        raise failed("this system cannot do it", BY_HAND) from failure
    except usb.core.USBError as failure:
        match failure.errno:
            case errno.ENOENT | errno.ENODEV:
                return  # it came back under a new address, which libusb reports as not found: a success
            case errno.EACCES:
                raise failed("no permission to open it", permit(wanted.vendor_id, wanted.product_id)) from failure
            case errno.ENOSYS:
                raise failed("this system cannot do it", BY_HAND) from failure
            case errno.EBUSY:
                raise failed("another program holds it", "close that program, then reset again") from failure
            case _:
                raise failed(str(failure), BY_HAND) from failure
    finally:
        usb.util.dispose_resources(handle)


def _found_again(
    before: UsbDevice, wanted: ExpectedUsbDevice, backend: Any, comes_back_s: float, clock: Clock
) -> UsbDevice:
    """Look for the device afresh, for pyusb's objects keep old addresses and texts."""
    until_s = clock.now_s() + comes_back_s
    while True:
        for device, _ in list_with_handles(backend):
            if _same(device, before):
                return device
        if clock.now_s() >= until_s:
            raise InstrumentLostError(str(wanted), RESETTING, f"it is not back after {comes_back_s:g} s", BY_HAND)
        clock.sleep(LOOKED_FOR_EVERY_S)


def _same(device: UsbDevice, before: UsbDevice) -> bool:
    """Whether this is the device from before, and answers as well as it did then."""
    if (device.vendor_id, device.product_id) != (before.vendor_id, before.product_id):
        return False
    if before.problem is Problem.NONE and device.problem is not Problem.NONE:
        return False
    if before.serial_number is not None:
        return device.serial_number == before.serial_number
    return device.port_path == before.port_path
