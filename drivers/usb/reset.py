"""A USB reset: the device is switched off and on by its port. A person's explicit choice, never a routine."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from typing import Any

from drivers.errors import InstrumentError, InstrumentLostError
from drivers.protocols import Clock, WallClock
from drivers.usb.devices import Problem, UsbDevice, list_with_handles, permit
from drivers.usb.matching import ExpectedUsbDevice, Verdict, match_devices

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
