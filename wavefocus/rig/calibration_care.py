"""Whether a rig's calibration can still be trusted: its age, and the devices it was made on."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime

from config.calibration_file import PARTS
from config.rig import RigConfig
from drivers.protocols import DeviceIdentity, Instruments

ROLE_OF = {"inputs": "recorder", "outputs": "player", "mirror": "mirror", "actuators": "player"}
"""Whose device a part of a calibration belongs to."""


def identities_of(instruments: Instruments) -> dict[str, DeviceIdentity]:
    """Who mirror, recorder and player are, by role."""
    return {
        "mirror": instruments.mirror.identity,
        "recorder": instruments.recorder.identity,
        "player": instruments.player.identity,
    }


def calibration_warnings(
    rig: RigConfig, identities: Mapping[str, DeviceIdentity], now: datetime | None = None
) -> list[str]:
    """What speaks against the calibration that a rig names; nothing where it names none.

    Parameters
    ----------
    rig : RigConfig
        The rig, its calibration read.
    identities : mapping from role to DeviceIdentity
        Of the instruments that are there.
    now : datetime, optional
        With a time zone; the present, if absent.
    """
    record = rig.calibration.measured
    if record is None:
        return []
    file, stale_days = rig.calibration.file, rig.calibration.stale_after_days
    now = now or datetime.now().astimezone()
    warnings = []
    for name in PARTS:
        part = getattr(record, name)
        if part is None:
            continue
        again = f"run wavefocus calibrate --only {name}"
        age_days = (now - part.at).total_seconds() / 86_400
        if age_days > stale_days:
            warnings.append(f"{file}: {name} measured {age_days:.0f} days ago, trusted for {stale_days:g}; {again}")
        if part.identity is None and ROLE_OF[name] in identities:
            words = f"({part.device})"
            warnings.append(f"{file}: {name} not comparable: the file names its device only in words {words}; {again}")
    for name, sentence in calibrated_elsewhere(rig, identities).items():
        warnings.append(f"{sentence}; run wavefocus calibrate --only {name}")
    return warnings


def calibrated_elsewhere(rig: RigConfig, identities: Mapping[str, DeviceIdentity]) -> dict[str, str]:
    """Parts of a rig's calibration that were measured on other devices than those there now.

    A part of which the file names the device only in words cannot be compared, and is left out.

    Parameters
    ----------
    rig : RigConfig
        The rig, its calibration read.
    identities : mapping from role to DeviceIdentity
        Of the instruments that are there.

    Returns
    -------
    dict from part to str
        A sentence for each.
    """
    record = rig.calibration.measured
    if record is None:
        return {}
    found = {}
    for name in PARTS:
        part, there = getattr(record, name), identities.get(ROLE_OF[name])
        if part is not None and part.identity is not None and there is not None and part.identity != there:
            device = f"({part.identity}); this is {there}"
            found[name] = f"{rig.calibration.file}: {name} measured on another device {device}"
    return found
