"""One bank, one calibration: what to say when a campaign would go on with another one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from config.plan_hash import plan_sha256
from config.rig import RigConfig
from drivers.protocols import Instruments
from storage.bank.reading import open_bank
from storage.errors import InputError
from wavefocus.campaign.blueprint import Blueprint, bank_configuration
from wavefocus.console import say
from wavefocus.rig.calibration_care import calibrated_elsewhere, identities_of


def with_one_calibration(blueprint: Blueprint, bank: Path, run_file: Path, *, accept: bool) -> Blueprint:
    """Refuse to go on in a bank with a calibration other than its own, or do so on purpose.

    Parameters
    ----------
    blueprint : Blueprint
        From the run file.
    bank : Path
        A bank that is there.
    run_file : Path
        For messages.
    accept : bool
        Go on with the run file's calibration all the same. Everything else must be as in the bank.

    Raises
    ------
    InputError
        They differ, and nobody accepts it.
    """
    with open_bank(bank) as view:
        if view.rig_json is None or view.run_json is None:
            return blueprint  # made by other means; refused in its own words later
        own, sha256 = bank_configuration(view).rig, view.plan_sha256
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


def refuse_other_devices(rig: RigConfig, instruments: Instruments, bank: Path, *, accept: bool) -> None:
    """Refuse to go on in a bank with instruments that its calibration was not made on.

    Raises
    ------
    InputError
        An instrument is another one, and nobody accepts it.
    """
    if rig.calibration.measured is None or accept:
        return
    if strangers := calibrated_elsewhere(rig, identities_of(instruments)):
        raise InputError(
            f"{bank}: {'; '.join(strangers.values())}; plug the right one in, start a new bank with a new calibration, "
            "or go on all the same by --accept-calibration"
        )


def _named(rig: RigConfig) -> str:
    record = rig.calibration.measured
    return "no calibration" if record is None else f"the calibration {rig.calibration.file} of {record.made:%Y-%m-%d}"


def _calibrated_as(rig: RigConfig, other: RigConfig) -> RigConfig:
    """A rig with all that a calibration says taken from another one."""
    return rig.model_copy(
        update={
            "mirror": rig.mirror.model_copy(update={"map": other.mirror.map, "distance_mm": other.mirror.distance_mm}),
            "recorder": rig.recorder.model_copy(update={"inter_channel_delay_s": other.recorder.inter_channel_delay_s}),
            "player": rig.player.model_copy(
                update={
                    "full_scale_v": other.player.full_scale_v,
                    "channel_full_scale_v": other.player.channel_full_scale_v,
                }
            ),
        }
    )
