"""``wavefocus doctor``: every instrument and what it needs checked, and what to do about each fault."""

import dataclasses
import platform
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from wavefocus.acquisition.doctor import RigFindings, examine
from wavefocus.config.messages import to_line
from wavefocus.config.messages.rig_checks import Act, Examination, Finding, FindingMade
from wavefocus.config.rig import RigConfig
from wavefocus.configuration import load_rig
from wavefocus.console import Exit, answer, print_line, say, spinner
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.exchange_record import noting_calls, recording
from wavefocus.drivers.protocols import DeviceIdentity
from wavefocus.drivers.registry import MIRRORS, PLAYERS, RECORDERS, SHUTTERS, VIBROMETERS
from wavefocus.drivers.timeouts import in_time
from wavefocus.ending import ending_at_once
from wavefocus.options import DoctorOptions
from wavefocus.rig.calibration_validity import calibration_warnings
from wavefocus.rig.instruments import open_shutter, openers_of
from wavefocus.rig.unattended import alive_findings, awake_finding, message_findings
from wavefocus.storage.durable import is_network_mount
from wavefocus.storage.errors import InputError

STYLES = {"ok": "green", "warn": "yellow", "fail": "bold red", "skipped": "dim"}


def doctor(rig_file: Path, options: DoctorOptions) -> Exit:
    """Examine a rig; exit code 1 when something is not good enough, whatever it is.

    A USB device is reset only where its role is named: the last resort, and never done unasked. As lines, each finding
    is one JSON line as soon as it is made, before the object that holds all.
    """
    record = options.record
    rig = load_rig(rig_file)
    if options.reset_usb:
        _reset(rig, rig_file, options.reset_usb)
    folder = rig_file.resolve().parent
    findings: list[Finding] = []
    openers, exchanges = openers_of(rig), None
    with ExitStack() as opened, spinner("examining") as status:
        if record is not None:
            roles = ("mirror", "recorder", "player", "vibrometer")
            drivers = {role: getattr(rig, role).driver for role in roles}
            made = datetime.now(UTC).isoformat()
            about = {"made": made, "rig": rig.rig.name, "drivers": drivers, "versions": versions()}
            try:
                exchanges = opened.enter_context(recording(record, about))
            except FileExistsError:
                raise InputError(f"--record {record}: exists already; name a new file") from None
            except OSError as failure:
                raise InputError(f"--record {record}: {failure.strerror}") from None
            noted: dict[str, Any] = {role: partial(_noted, getattr(openers, role), role) for role in roles[:3]}
            openers = dataclasses.replace(openers, **noted)
        resettable = {one.role for one in rig.usb}

        def publish(finding: Finding) -> None:
            if finding.verdict == "fail" and finding.act is None and finding.instrument in resettable:
                finding = replace(finding, act=Act("reset-usb", finding.instrument))
            findings.append(finding)
            if options.as_lines:
                print_line(to_line(FindingMade(finding)))
            if status is not None:
                status.update(f"examining; {finding.instrument}: {finding.check}: {finding.verdict}")

        with ending_at_once():
            identities = examine(openers, publish, play=options.play)
            for finding in shutter_findings(rig):
                publish(finding)
        _check_surroundings(rig, folder, identities, publish)
        for finding in message_findings(rig, rig_file.name, send=options.test_message):
            publish(finding)
        for finding in alive_findings(rig.messages) if options.test_message else ():
            publish(finding)
        publish(awake_finding())
        if exchanges is not None:
            what = f"{record} is incomplete: {exchanges.failure}"
            publish(
                Finding("record", "file", "fail", what, "name a file elsewhere")
                if exchanges.failure
                else Finding("record", "file", "ok", f"every exchange is in {record}")
            )
    failed = sum(one.verdict == "fail" for one in findings)
    if options.as_json or options.as_lines:
        counts = {word: sum(one.verdict == word for one in findings) for word in STYLES}
        print_line(to_line(Examination(str(rig_file), rig.rig.name, failed == 0, counts, tuple(findings), versions())))
    else:
        _show(findings)
        answer(", ".join(f"{package} {number}" for package, number in versions().items()))
    warned = sum(one.verdict == "warn" for one in findings)
    line = say if options.as_json or options.as_lines else answer
    line(f"{rig_file}: {failed} not good enough, {warned} to look at, {len(findings)} findings")
    return Exit.NOT_GOOD_ENOUGH if failed else Exit.DONE


def _noted(opener: Callable[[], Any], role: str) -> Any:
    """Open an instrument whose calls are noted."""
    return noting_calls(opener(), role)


def _reset(rig: RigConfig, rig_file: Path, role: str) -> None:
    from wavefocus.drivers.usb import reset_device

    device = next((device for device in rig.usb if device.role == role), None)
    if device is None:
        roles = ", ".join(sorted({device.role for device in rig.usb})) or "none"
        raise InputError(f"--reset-usb {role}: {rig_file} has no [[usb]] table of that role; it has {roles}")
    say(f"{role}: reset; it is now {reset_device(**device.model_dump())}")


def _show(findings: list[Finding]) -> None:
    """A table for people; what there is to do stands below what was found."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for heading in ("", "instrument", "check", "found"):
        table.add_column(heading, overflow="fold")
    for one in findings:
        found = f"{one.what}\n-> {one.remedy}" if one.remedy else one.what
        # Square brackets of a finding are text, not markup.
        verdict = f"[{STYLES[one.verdict]}]{one.verdict}[/]"
        table.add_row(verdict, one.instrument, one.check, found.replace("[", r"\["))
    Console(highlight=False, soft_wrap=True).print(table)


PACKAGES = ("wavefocus", "numpy", "scipy", "h5py", "pydantic", "pyserial", "nidaqmx", "grpcio", "sounddevice", "pyusb")


def versions() -> dict[str, str]:
    """Versions of Python, of the system and of the packages that matter; "missing" where there is none."""
    facts = {"python": platform.python_version(), "system": platform.platform()}
    for package in PACKAGES:
        try:
            facts[package] = version(package)
        except PackageNotFoundError:
            facts[package] = "missing"
    return facts


def _check_surroundings(
    rig: RigConfig, folder: Path, identities: Mapping[str, DeviceIdentity], publish: Callable[[Finding], None]
) -> None:
    """Look at all that is not an instrument."""
    findings = RigFindings(publish)
    _check_packages(rig, findings)
    for registry in (MIRRORS, RECORDERS, PLAYERS, VIBROMETERS, SHUTTERS):
        for name, why in registry.failures.items():
            findings.add("packages", f"driver {name}", "warn", why, "repair or uninstall the package that provides it")
    free = shutil.disk_usage(folder).free
    what = f"{free / 1e9:.1f} GB free at {folder}"
    # A campaign of 1500 positions with 20 actuators is a quarter of a gigabyte, and a log next to it.
    if free < 2e9:
        act = Act("open-folder", str(folder))
        findings.add("disk", "free space", "warn", what, "make room, or measure to another disk", act)
    elif is_network_mount(folder):
        findings.add("disk", "free space", "warn", f"{what}, a network drive", "measure to a local disk")
    else:
        findings.add("disk", "free space", "ok", what)
    _check_usb(rig, findings)
    _check_calibration(rig, identities, findings)


def _check_packages(rig: RigConfig, findings: RigFindings) -> None:
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
        packages = ['"wavefocus[remote]"' if package == "grpcio" else package for package in missing]
        what, remedy = f"missing: {', '.join(missing)}", f"pip install {' '.join(packages)}"
        findings.add("packages", "installed", "fail", what, remedy, Act("run", remedy))
        return
    used = ", ".join(f"{package} {there[package]}" for package, wanted in needed.items() if wanted)
    findings.add("packages", "installed", "ok", used or f"none needed, wavefocus {there['wavefocus']}")


def _check_usb(rig: RigConfig, findings: RigFindings) -> None:
    if not rig.usb:
        return
    from wavefocus.drivers.usb import find_device, list_devices

    plugged_in = findings.ask("usb", "devices", list_devices, 60.0)
    if plugged_in is None:
        return
    for device in rig.usb:
        try:
            found = find_device(plugged_in, **device.model_dump())
        except InstrumentError as failure:
            findings.add("usb", device.role, "fail", failure.cause, failure.remedy, Act("edit-rig", "usb"))
        else:
            findings.add("usb", device.role, "ok", str(found))


def _check_calibration(rig: RigConfig, identities: Mapping[str, DeviceIdentity], findings: RigFindings) -> None:
    record = rig.calibration.measured
    if record is None:
        if not rig.is_virtual:
            why = "the rig file names none"
            findings.add("calibration", "file", "warn", why, "run wavefocus calibrate", Act("calibrate"))
        return
    for warning in calibration_warnings(rig, identities):
        findings.add("calibration", "file", "warn", warning.reason, warning.remedy, Act("calibrate", warning.part))
    for one in record.actuators.actuator if record.actuators is not None else ():
        if one.verdict != "good":
            what, remedy = f"actuator {one.actuator} was {one.verdict} ({one.level_db:+.1f} dB)", "--only actuators"
            act = Act("calibrate", "actuators")
            findings.add("calibration", "actuators", "warn", what, f"see wavefocus calibrate {remedy}", act)
    findings.add("calibration", "file", "ok", f"{rig.calibration.file}, made {record.made:%Y-%m-%d}")


CALL_S = 10.0


def shutter_findings(rig: RigConfig) -> Iterator[Finding]:
    """Close, open and close the shutter while the mirror is parked; nothing where the rig has none."""
    section = rig.shutter
    if section is None:
        return
    try:
        shutter = in_time("shutter", "opening", lambda: open_shutter(section), CALL_S)
        try:
            for operation, act in (
                ("closing", shutter.block_beam),
                ("opening", shutter.open_beam),
                ("closing", shutter.block_beam),
            ):
                in_time("shutter", operation, act, CALL_S)
            name = shutter.identify()
        finally:
            in_time("shutter", "releasing", shutter.close, CALL_S)
    except InstrumentError as failure:
        what = f"{failure.operation}: {failure.cause}; nothing is measured without it"
        yield Finding("shutter", "open and close", "fail", what, failure.remedy, Act("edit-rig", "shutter"))
        return
    yield Finding("shutter", "open and close", "ok", f"{name}; closed now")
