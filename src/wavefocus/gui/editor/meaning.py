"""What the text of a run or rig file means: the surface, and figures or channels; computed in a thread."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavefocus.acquisition.wording import hours
from wavefocus.gui.surface import PlotSurface, plan_surface


@dataclass(frozen=True, slots=True, eq=False)
class Meaning:
    """A surface with lines of text, and a table with titles; either may be empty."""

    surface: PlotSurface
    lines: Sequence[str]
    titles: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()


def meaning_of_run(text: str, path: Path) -> Meaning:
    """Grid, actuators and hours of a run. Raises InputError: The run cannot be carried out."""
    from wavefocus.acquisition.plan import schedule_name  # loads SciPy, and this runs in a thread
    from wavefocus.campaign.blueprint import blueprint_of
    from wavefocus.configuration import check_rows, load_run

    configuration = load_run(path, text)
    blueprint = blueprint_of(configuration)
    plan, rig = blueprint.plan, configuration.rig
    checks = check_rows(configuration)
    start_hz, stop_hz = plan.excitation.band_hz
    lines = [
        f"{plan.positions - len(checks)} positions on the grid, {len(checks)} check positions (rings), "
        f"{plan.actuators} actuators",
        f"{hours(plan.campaign_s(plan.order, rig.recorder))} in all; {schedule_name(plan)}, "
        f"{start_hz:g} to {stop_hz:g} Hz, {plan.excitation.amplitude_v:g} V",
        f"bank of {blueprint.bank_header().file_bytes / 1e6:.0f} MB",
    ]
    return Meaning(plan_surface(rig, np.asarray(configuration.position_mm), checks), lines)


def meaning_of_rig(text: str, path: Path) -> Meaning:
    """Channels and limits of a rig. Raises InputError: The rig file is wrong."""
    from wavefocus.configuration import load_rig
    from wavefocus.rig.limits import limits_of

    rig = load_rig(path, text)
    player, limits = rig.player, limits_of(rig.player)
    rms = "" if limits.rms_v is None else f"{limits.rms_v:g} V"
    rows = [
        (str(actuator), f"{x_mm:g}, {y_mm:g}", str(channel), f"{player.output_full_scale_v[channel]:g} V",
         f"{limits.peak_v:g} V", rms)
        for actuator, ((x_mm, y_mm), channel) in enumerate(zip(rig.actuators.position_mm, player.channels, strict=True))
    ]  # fmt: skip
    rows.append(("loopback", "", str(player.loopback_channel), "", "", ""))
    instruments = ("mirror", "recorder", "player", "vibrometer")
    lines = [
        f"{len(player.channels)} actuators on a surface of {rig.surface.length_mm:g} × {rig.surface.width_mm:g} mm",
        "drivers: " + ", ".join(f"{name} {getattr(rig, name).driver}" for name in instruments),
    ]
    titles = ("actuator", "place (mm)", "channel", "full scale", "limit", "rms limit")
    return Meaning(plan_surface(rig, np.asarray(rig.actuator_mm), ()), lines, titles, rows)


MEANINGS = {"run": meaning_of_run, "rig": meaning_of_rig}
