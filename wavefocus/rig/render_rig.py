"""The rig that a scene is rendered for: its limits and its outputs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from config.rig import RigConfig, default_rig
from rendering.drive.coil_limits import Limiting
from rendering.drive.wav import Interface
from rendering.scene.model import Scene
from storage.bank.reading import Bank
from storage.errors import InputError
from wavefocus.campaign.blueprint import bank_configuration
from wavefocus.configuration import load_rig
from wavefocus.rig.rig_limits import stricter

# A bank made by other means does not know the interface; then the WAV says volts at the common rate.
DEFAULT_INTERFACE_RATE_HZ = 48_000
DEFAULT_FULL_SCALE_V = 1.0


def rig_of(rig_file: Path | None, bank: Bank) -> RigConfig | None:
    """The rig that was named, else the bank's own; None where neither is known."""
    if rig_file is None:
        return None if bank.rig_json is None or bank.run_json is None else bank_configuration(bank).rig
    rig = default_rig() if str(rig_file) == "virtual" else load_rig(rig_file)
    if len(rig.player.channels) != bank.actuators:
        raise InputError(f"{rig_file} has {len(rig.player.channels)} actuators, {bank.path} {bank.actuators}")
    return rig


def within(scene: Scene, rig: RigConfig) -> Scene:
    """The scene with the limits of the rig where they are stricter than its own."""
    limits = stricter(scene.output, rig.player)
    return replace(scene, output=replace(scene.output, limit_v=limits.peak_v, limit_rms_v=limits.rms_v))


def limited_words(limiting: Limiting, rig_file: Path | None) -> str:
    """What the limits did, and whose they are."""
    where = "" if rig_file is None else f" (the scene's or {rig_file}'s, whichever is stricter)"
    return f"{limiting}{where}"


def interface_of(rig: RigConfig) -> Interface:
    """The outputs that a rig's actuators hang on."""
    player = rig.player
    each_v = [player.output_full_scale_v[channel] for channel in player.channels]
    return Interface(player.interface_rate_hz, np.array(each_v))
