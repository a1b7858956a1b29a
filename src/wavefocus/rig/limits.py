"""What a rig's actuators may get: limits of a scene, refusal of drives beyond them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.config.scene import Output
from wavefocus.rendering.drive.coil_limits import DriveLimits, Limiting, levels_of
from wavefocus.rendering.drive.wav import Interface
from wavefocus.rendering.scene.model import Scene
from wavefocus.storage.bank.reading import Bank
from wavefocus.storage.drive_file import Drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.units import PLAYED_UNITS

if TYPE_CHECKING:
    from wavefocus.config.rig import RigConfig
    from wavefocus.config.rig_instruments import PlayerSection


def limits_of(player: PlayerSection) -> DriveLimits:
    """The limits of a rig's actuators."""
    rms = player.rms_limit
    return DriveLimits(
        peak_v=player.largest_v,
        rms_v=None if rms is None else rms[1],
        peak_key="player.limit_v" if player.limit_v == player.largest_v else "player.channel_full_scale_v",
        rms_key="limit_rms_v" if rms is None else rms[0],
    )


def stricter(output: Output, player: PlayerSection) -> DriveLimits:
    """The limits of a scene and of a rig together."""
    return DriveLimits(output.limit_v, output.limit_rms_v).with_limits(limits_of(player))


def check_drive(
    drive: Drive, player: PlayerSection, source: str, remedy: str, *, repeated: bool = False, gain_db: float = 0.0
) -> None:
    """Refuse a drive that the rig's actuators may not get; only a person may say that it is to be scaled.

    Raises InputError: the drive is not in volts, or an actuator would get more than it may.
    """
    if drive.drive_unit not in PLAYED_UNITS:
        raise InputError(
            f"{source} is in {drive.drive_unit}, and the player plays volts; render it from a bank in volts"
        )
    limits = limits_of(player)
    for reached in levels_of(drive.drive_v, drive.sample_rate_hz, repeated=repeated, limits=limits).against(limits):
        actuator, kind = int(np.argmax(reached.each_v)), " rms" if reached.summed else ""
        most_v, limit_v = float(reached.each_v[actuator]), reached.limit_v
        if most_v > limit_v * (1 + 1e-9):
            enough_db = math.floor(100 * (gain_db + 20 * math.log10(limit_v / most_v))) / 100
            raise InputError(
                f"{source}: the drive of actuator {actuator} reaches {most_v:.4g} V{kind}; the rig's actuators may get"
                f" {limit_v:.4g} V{kind} ({reached.key}): {remedy.format(gain_db=f'{enough_db:.2f}')}"
            )


def rig_of(rig_file: Path | None, bank: Bank) -> RigConfig | None:
    """The rig that was named, else the bank's own; None where neither is known."""
    from wavefocus.campaign.blueprint import bank_configuration
    from wavefocus.configuration import named_rig

    if rig_file is None:
        return None if bank.rig_json is None or bank.run_json is None else bank_configuration(bank).rig
    rig = named_rig(rig_file)
    if len(rig.player.channels) != bank.actuators:
        raise InputError(
            f"{rig_file} has {len(rig.player.channels)} actuators, {bank.path} {bank.actuators}: choose the rig that"
            " the bank was measured with"
        )
    return rig


def within(scene: Scene, rig: RigConfig) -> Scene:
    """The scene with the limits of the rig where they are stricter than its own."""
    limits = stricter(scene.output, rig.player)
    return replace(
        scene, output=scene.output.model_copy(update={"limit_v": limits.peak_v, "limit_rms_v": limits.rms_v})
    )


def limited_words(limiting: Limiting, rig_file: Path | None) -> str:
    """What the limits did, and whose they are."""
    where = "" if rig_file is None else f" (the scene's or {rig_file}'s, whichever is stricter)"
    return f"{limiting}{where}"


def interface_of(rig: RigConfig) -> Interface:
    """The outputs that a rig's actuators hang on."""
    player = rig.player
    each_v = [player.output_full_scale_v[channel] for channel in player.channels]
    return Interface(player.interface_rate_hz, np.array(each_v))
