"""Whether a rig's calibration still holds: its age, its devices, and that one bank has one calibration."""

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from wavefocus.campaign.blueprint import Blueprint
from wavefocus.config.rig import RigConfig
from wavefocus.configuration import plan_sha256
from wavefocus.console import say
from wavefocus.drivers.protocols import DeviceIdentity
from wavefocus.options import CALIBRATION_PARTS
from wavefocus.storage.errors import InputError

_ROLE_OF = {"inputs": "recorder", "outputs": "player", "mirror": "mirror", "actuators": "player"}
"""Whose device a part of a calibration belongs to."""


class _CalibrationWarning(NamedTuple):
    """What speaks against one part of a calibration."""

    part: str
    reason: str

    @property
    def remedy(self) -> str:
        """The command that measures the part again."""
        return f"run wavefocus calibrate --only {self.part}"

    def __str__(self) -> str:
        return f"{self.reason}; {self.remedy}"


def calibration_warnings(
    rig: RigConfig, identities: Mapping[str, DeviceIdentity], now: datetime | None = None
) -> list[_CalibrationWarning]:
    """What speaks against the calibration that a rig names; nothing where it names none."""
    record = rig.calibration.measured
    if record is None:
        return []
    file, stale_days = rig.calibration.file, rig.calibration.stale_after_days
    now = now or datetime.now().astimezone()
    warnings = []
    for name in CALIBRATION_PARTS:
        part = getattr(record, name)
        if part is None:
            continue
        age_days = (now - part.at).total_seconds() / 86_400
        if age_days > stale_days:
            reason = f"{file}: {name} measured {age_days:.0f} days ago, trusted for {stale_days:g}"
            warnings.append(_CalibrationWarning(name, reason))
        if age_days < -1:
            reason = f"{file}: {name} dated {-age_days:.0f} days ahead of this computer's clock: its age is unknown"
            warnings.append(_CalibrationWarning(name, reason))
        if part.identity is None and _ROLE_OF[name] in identities:
            reason = f"{file}: {name} not comparable: the file names its device only in words ({part.device})"
            warnings.append(_CalibrationWarning(name, reason))
    return warnings + [_CalibrationWarning(*one) for one in calibrated_elsewhere(rig, identities).items()]


def calibrated_elsewhere(rig: RigConfig, identities: Mapping[str, DeviceIdentity]) -> dict[str, str]:
    """Parts of a rig's calibration that were measured on other devices than those there now.

    A part of which the file names the device only in words cannot be compared, and is left out.

    Returns a sentence for each.
    """
    record = rig.calibration.measured
    if record is None:
        return {}
    found = {}
    for name in CALIBRATION_PARTS:
        part, there = getattr(record, name), identities.get(_ROLE_OF[name])
        if part is None or part.identity is None or there is None:
            continue
        if not part.identity.is_same(there):
            device = f"({part.identity}); this is {there}"
            found[name] = f"{rig.calibration.file}: {name} measured on another device {device}"
    return found


def with_one_calibration(
    blueprint: Blueprint, bank: Path, run_file: Path, own: RigConfig, sha256: str | None, *, accept: bool
) -> Blueprint:
    """Refuse to go on in a bank, of rig `own`, with a calibration other than its own, or do so on purpose.

    Raises InputError: they differ, and nobody accepts it.
    """
    new = blueprint.configuration.rig
    if new.calibration.measured == own.calibration.measured:
        return blueprint
    if not accept:
        raise InputError(
            f"{bank}: was measured with {_named(own)}, {run_file} goes by {_named(new)}; go on with the bank's own by "
            f"wavefocus resume {bank}, or with the other one on purpose by --accept-calibration, or start a new bank"
        )
    configuration = blueprint.configuration
    if plan_sha256(_calibrated_as(new, own), configuration.run, configuration.position_mm) == sha256:
        say(f"warning: {bank} goes on with {_named(new)} in place of {_named(own)}, as accepted")
        return replace(blueprint, plan=replace(blueprint.plan, sha256=sha256))
    return blueprint


def refuse_other_devices(rig: RigConfig, identities: Mapping[str, DeviceIdentity], bank: Path, *, accept: bool) -> None:
    """Refuse to go on in a bank with instruments that its calibration was not made on.

    Raises InputError: an instrument is another one, and nobody accepts it.
    """
    if rig.calibration.measured is None or accept:
        return
    if strangers := calibrated_elsewhere(rig, identities):
        raise InputError(
            f"{bank}: {'; '.join(strangers.values())}; plug the right one in, start a new bank with a new calibration, "
            "or go on all the same by wavefocus resume with --accept-calibration"
        )


def _named(rig: RigConfig) -> str:
    record = rig.calibration.measured
    return "no calibration" if record is None else f"the calibration {rig.calibration.file} of {record.made:%Y-%m-%d}"


def _calibrated_as(rig: RigConfig, other: RigConfig) -> RigConfig:
    """A rig with all that a calibration says taken from another one."""
    of_table = {
        "mirror": ("map", "distance_mm"), "recorder": ("inter_channel_delay_s",),
        "player": ("full_scale_v", "channel_full_scale_v"),
    }  # fmt: skip
    tables = {}
    for name, keys in of_table.items():
        theirs = getattr(other, name)
        tables[name] = getattr(rig, name).model_copy(update={key: getattr(theirs, key) for key in keys})
    return rig.model_copy(update=tables)
