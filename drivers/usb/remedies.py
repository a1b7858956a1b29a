"""What a person does about USB, system by system."""

from __future__ import annotations

import sys

RULES_FILE = "/etc/udev/rules.d/70-wavefocus.rules"


def install_libusb(platform: str = sys.platform) -> str:
    """How libusb is installed.

    Parameters
    ----------
    platform : str
        As ``sys.platform`` names it.
    """
    if platform == "win32":
        return "put libusb-1.0.dll (https://libusb.info, VS2019/MS64/dll) beside python.exe"
    if platform == "darwin":
        return "install libusb: brew install libusb"
    return "install libusb: sudo apt install libusb-1.0-0, or your system's package of that name"


def udev_rule(vendor_id: int, product_id: int) -> str:
    """The line that lets whoever sits at the machine open a device, for a file such as `RULES_FILE`."""
    return (
        f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{vendor_id:04x}", ATTR{{idProduct}}=="{product_id:04x}", '
        'MODE="0660", TAG+="uaccess"'
    )


def permit(vendor_id: int, product_id: int, platform: str = sys.platform) -> str:
    """How a device may be opened.

    Parameters
    ----------
    vendor_id, product_id : int
        The device's.
    platform : str
        As ``sys.platform`` names it.
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
