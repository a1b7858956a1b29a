"""``wavefocus gui``: opens the window."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from wavefocus.campaign.sidecar_files import log_path, raw_path, session_failure
from wavefocus.campaign.supervision import read_heartbeat
from wavefocus.gui.front_door import FrontDoor, PlannedCampaign, RigLimits, open_window

if TYPE_CHECKING:
    from wavefocus.acquisition.limits import DriftPoint


def gui(files: Sequence[Path]) -> int:
    """Show the window until it is closed.

    Raises InputError: there is no display, Qt cannot be loaded, or the system has no font.
    """
    return open_window(front_door(), files)


def front_door() -> FrontDoor:
    """Facts of the command line that the window needs."""
    return FrontDoor(
        command=(sys.executable, "-m", "wavefocus"),
        log_path=log_path,
        raw_path=raw_path,
        session_failure=session_failure,
        said_path=lambda bank: bank.with_name(f"{bank.name}.said"),
        read_drift=_drift,
        read_heartbeat=read_heartbeat,
        read_rig_limits=_rig_limits,
        read_plan=_planned,
    )


def _drift(bank: Path) -> list[DriftPoint]:
    from wavefocus.campaign.sidecar_files import read_drift  # in the window's own time: it draws pictures, too

    return read_drift(bank)


def _planned(run_file: Path) -> PlannedCampaign:
    from wavefocus.campaign.blueprint import blueprint_from_files  # in a thread of the window

    blueprint = blueprint_from_files(run_file)
    rig, plan = blueprint.configuration.rig, blueprint.plan
    return PlannedCampaign(
        plan.position_mm, plan.actuator_mm, rig.surface.outline.line(181), plan.campaign_s(plan.order, rig.recorder)
    )


def _rig_limits(path: Path) -> RigLimits:
    from wavefocus.configuration import named_rig  # in the process that calculates scenes
    from wavefocus.rig.limits import limits_of

    player = named_rig(path).player
    return RigLimits(limits_of(player), len(player.channels), player.coil_resistance_ohm)
