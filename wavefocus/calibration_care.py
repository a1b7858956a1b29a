"""Whether a rig's calibration can still be trusted: its age, and the devices it was made on."""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import datetime

from drivers.errors import InstrumentError
from drivers.protocols import Instruments
from wavefocus.config.calibration_file import PARTS
from wavefocus.config.rig import RigConfig

ROLE_OF = {"inputs": "recorder", "outputs": "player", "mirror": "mirror", "actuators": "player"}
"""Whose device a part of a calibration belongs to."""

# What a device says of its settings and of the way to it; the rest is the device itself.
_SETTINGS = re.compile(
    r"within \+-.*|full scale .*|latency .*|ranges up to .*|\d+ (of \d+ )?channels.*|\d+ bit|"
    r"PortAudio.*|revision .*|NI-DAQmx .*|driver .*",
    re.IGNORECASE,
)
_WAY = re.compile(r" at [^),:]+(:\d+)?(?=[),:]|$)| via .*$")


def names_known(instruments: Instruments) -> dict[str, str]:
    """What the instruments say they are; one that does not answer is left to whoever measures with it."""
    names = {}
    for role, instrument in (
        ("mirror", instruments.mirror),
        ("recorder", instruments.recorder),
        ("player", instruments.player),
    ):
        try:
            names[role] = instrument.identify()
        except InstrumentError:
            continue
    return names


def calibration_warnings(rig: RigConfig, names: Mapping[str, str], now: datetime | None = None) -> list[str]:
    """What speaks against the calibration that a rig names; nothing where it names none.

    Parameters
    ----------
    rig : RigConfig
        The rig, its calibration read.
    names : mapping from role to str
        What the instruments say they are, of those that answered.
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
    for name, sentence in calibrated_elsewhere(rig, names).items():
        warnings.append(f"{sentence}; run wavefocus calibrate --only {name}")
    return warnings


def calibrated_elsewhere(rig: RigConfig, names: Mapping[str, str]) -> dict[str, str]:
    """Parts of a rig's calibration that were measured on other devices than those there now.

    Parameters
    ----------
    rig : RigConfig
        The rig, its calibration read.
    names : mapping from role to str
        What the instruments say they are, of those that answered.

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
        part, there = getattr(record, name), names.get(ROLE_OF[name])
        if part is not None and there is not None and device_itself(there) != device_itself(part.device):
            device = f"({part.device}); this is {there}"
            found[name] = f"{rig.calibration.file}: {name} measured on another device {device}"
    return found


def device_itself(identity: str) -> str:
    """Who a device is, without what it says of its settings and of the way to it."""
    clauses = [clause.strip() for clause in _WAY.sub("", identity).split(",")]
    return ", ".join(clause for clause in clauses if not _SETTINGS.fullmatch(clause))
