"""What the doctor looks at beside the instruments: packages, disk, USB, calibration."""

from __future__ import annotations

import platform
import shutil
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from acquisition.doctor.findings import Act, Finding, Findings
from config.rig import RigConfig
from drivers.protocols import DeviceIdentity
from rendering.inner_loops import inner_loops
from storage.network_mount import is_network_mount
from wavefocus.rig.calibration_care import calibration_warnings

PACKAGES = ("wavefocus", "numpy", "scipy", "h5py", "pydantic", "pyserial", "nidaqmx", "grpcio", "sounddevice", "pyusb")
# A night of 1500 positions with 20 actuators is a quarter of a gigabyte, and a log beside it.
LEAST_FREE_BYTES = 2_000_000_000
USB_S = 60.0


def versions() -> dict[str, str]:
    """Versions of Python, of the system and of the packages that matter; "missing" where there is none.

    Beside them whether the inner loops of rendering are compiled; where not, numpy takes a third longer or more.
    """
    told = {"python": platform.python_version(), "system": platform.platform()}
    for package in PACKAGES:
        try:
            told[package] = version(package)
        except PackageNotFoundError:
            told[package] = "missing"
    told["inner loops"] = "compiled" if inner_loops() else "numpy"
    return told


def check_surroundings(
    rig: RigConfig, folder: Path, identities: Mapping[str, DeviceIdentity], publish: Callable[[Finding], None]
) -> None:
    """Look at all that is not an instrument.

    Parameters
    ----------
    rig : RigConfig
        The rig.
    folder : Path
        Where banks will be written.
    identities : mapping from role to DeviceIdentity
        Of the instruments that answered.
    publish : callable
        Gets each finding.
    """
    findings = Findings(publish)
    _check_packages(rig, findings)
    _check_disk(folder, findings)
    _check_usb(rig, findings)
    _check_calibration(rig, identities, findings)


def _check_packages(rig: RigConfig, findings: Findings) -> None:
    there = versions()
    needed = {
        "pyserial": rig.mirror.port is not None or rig.vibrometer.port is not None,
        "nidaqmx": rig.recorder.driver == "nidaqmx",
        "grpcio": rig.recorder.address is not None,
        "sounddevice": rig.player.driver == "sounddevice",
        "pyusb": bool(rig.usb),
    }
    missing = [package for package, wanted in needed.items() if wanted and there[package] == "missing"]
    if missing:
        what, remedy = f"missing: {', '.join(missing)}", f"pip install {' '.join(missing)}"
        findings.add("packages", "installed", "fail", what, remedy, Act("run", remedy))
        return
    used = ", ".join(f"{package} {there[package]}" for package, wanted in needed.items() if wanted)
    findings.add("packages", "installed", "ok", used or f"none needed, wavefocus {there['wavefocus']}")


def _check_disk(folder: Path, findings: Findings) -> None:
    free = shutil.disk_usage(folder).free
    what = f"{free / 1e9:.1f} GB free at {folder}"
    if free < LEAST_FREE_BYTES:
        findings.add(
            "disk", "free space", "warn", what, "make room, or measure to another disk", Act("open-folder", str(folder))
        )
    elif is_network_mount(folder):
        findings.add("disk", "free space", "warn", f"{what}, a network drive", "measure to a local disk")
    else:
        findings.add("disk", "free space", "ok", what)


def _check_usb(rig: RigConfig, findings: Findings) -> None:
    if not rig.usb:
        return
    from drivers.usb.devices import list_devices
    from drivers.usb.matching import ExpectedUsbDevice, Verdict, match_devices

    plugged_in = findings.ask("usb", "devices", list_devices, USB_S)
    if plugged_in is None:
        return
    expected = [ExpectedUsbDevice(**one.model_dump()) for one in rig.usb]
    for found in match_devices(expected, plugged_in):
        good = found.verdict is Verdict.FOUND
        act = Act("reset-usb", found.expected.role) if found.verdict is Verdict.UNREADABLE else None
        if found.verdict in (Verdict.SEVERAL, Verdict.OTHER_SERIAL, Verdict.MISSING):
            act = Act("edit-rig", "usb")
        findings.add("usb", found.expected.role, "ok" if good else "fail", found.sentence, found.remedy, act)


def _check_calibration(rig: RigConfig, identities: Mapping[str, DeviceIdentity], findings: Findings) -> None:
    record = rig.calibration.measured
    if record is None:
        if not rig.is_virtual:
            findings.add(
                "calibration", "file", "warn", "the rig file names none", "run wavefocus calibrate", Act("calibrate")
            )
        return
    for warning in calibration_warnings(rig, identities):
        what, _, remedy = warning.rpartition("; ")
        findings.add("calibration", "file", "warn", what, remedy, Act("calibrate", remedy.rpartition(" ")[2]))
    for one in record.actuators.actuator if record.actuators is not None else ():
        if one.verdict != "good":
            what, act = (
                f"actuator {one.actuator} was {one.verdict} ({one.level_db:+.1f} dB)",
                Act("calibrate", "actuators"),
            )
            findings.add("calibration", "actuators", "warn", what, "see wavefocus calibrate --only actuators", act)
    findings.add("calibration", "file", "ok", f"{rig.calibration.file}, made {record.made:%Y-%m-%d}")
