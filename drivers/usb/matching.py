"""Whether what is plugged in is what the rig expects."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from drivers.usb.devices import Problem, UsbDevice, permit


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
    plugged_in: From :func:`drivers.usb.devices.list_devices`.
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
        find = _by_ids if one.serial_number is None else _by_serial
        findings[index] = find(one, candidates, platform)
        if findings[index].verdict is Verdict.FOUND:
            left.remove(findings[index].devices[0])
    return tuple(findings[index] for index in range(len(expected)))


def _by_ids(expected: ExpectedUsbDevice, candidates: list[UsbDevice], platform: str) -> Finding:
    if not candidates:
        return _missing(expected)
    if len(candidates) > 1:
        serials = _listed(candidates)
        return Finding(
            expected,
            Verdict.SEVERAL,
            tuple(candidates),
            f"{expected}: {len(candidates)} such devices are plugged in: {serials}",
            "write the serial_number of the right one into its [[usb]] table",
        )
    return _found(expected, candidates[0], platform)


def _by_serial(expected: ExpectedUsbDevice, candidates: list[UsbDevice], platform: str) -> Finding:
    if not candidates:
        return _missing(expected)
    same = [device for device in candidates if _equal(device.serial_number, expected.serial_number)]
    if len(same) == 1:
        return _found(expected, same[0], platform)
    if same:
        return Finding(
            expected,
            Verdict.SEVERAL,
            tuple(same),
            f"{expected}: {len(same)} devices claim that serial number: {_listed(same)}",
            "unplug the one that does not belong to the rig",
        )
    closed = [device for device in candidates if device.problem in (Problem.NO_PERMISSION, Problem.HELD_BY_DRIVER)]
    if closed:
        return Finding(
            expected,
            Verdict.NO_PERMISSION,
            tuple(closed),
            f"{expected}: its serial number cannot be read: {closed[0].problem}",
            permit(expected.vendor_id, expected.product_id, platform),
        )
    silent = [device for device in candidates if device.problem is Problem.UNREADABLE]
    if silent:
        return Finding(
            expected,
            Verdict.UNREADABLE,
            tuple(silent),
            f"{expected}: its serial number cannot be read: {silent[0].problem}",
            "unplug it and plug it in again, without a hub if there is one",
        )
    serials = ", ".join(device.serial_number or "none" for device in candidates)
    return Finding(
        expected,
        Verdict.OTHER_SERIAL,
        tuple(candidates),
        f"{expected}: plugged in is another one, serial number {serials}",
        "plug in the rig's own device, or write the new one's serial_number into its [[usb]] table and calibrate again",
    )


def _found(expected: ExpectedUsbDevice, device: UsbDevice, platform: str) -> Finding:
    if device.problem is Problem.NONE:
        return Finding(expected, Verdict.FOUND, (device,), f"{expected}: {device}")
    advice = ""
    if device.problem is Problem.NO_PERMISSION:
        advice = f"only a USB reset needs it; to permit it: {permit(expected.vendor_id, expected.product_id, platform)}"
    return Finding(
        expected, Verdict.FOUND, (device,), f"{expected}: {device}; its names cannot be read: {device.problem}", advice
    )


def _missing(expected: ExpectedUsbDevice) -> Finding:
    return Finding(
        expected,
        Verdict.MISSING,
        (),
        f"{expected}: it is not plugged in",
        "check its cable, its power and the hub, and the vendor_id and product_id in its [[usb]] table",
    )


def _listed(devices: Sequence[UsbDevice]) -> str:
    return "; ".join(str(device) for device in devices)


def _equal(found: str | None, expected: str | None) -> bool:
    """Serial numbers are compared as people copy them from labels: without regard to case and spaces around."""
    return found is not None and expected is not None and found.strip().casefold() == expected.strip().casefold()
