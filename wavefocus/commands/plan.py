"""``wavefocus plan``: the dry run."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Sequence
from dataclasses import asdict
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from acquisition.durations import hours
from acquisition.expectation import ASSUMED_SNR_DB, schedule_name
from acquisition.plan import Plan
from acquisition.roles import names_of
from wavefocus.blueprint import blueprint_from_files
from wavefocus.comparison import compared
from wavefocus.compose import open_setup
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import RunConfig
from wavefocus.console import say
from wavefocus.grid_advice import Waves, advice_lines, grid_advice, top_hz_of

if TYPE_CHECKING:
    from rendering.scene import Scene


def plan(
    run_file: Path,
    scene_files: Sequence[Path] = (),
    waves: Waves = Waves(),  # noqa: B008  # frozen
    *,
    checks: bool = True,
    as_json: bool,
) -> None:
    """Walk the plan without playing anything and tell what it would take; for some scenes alone if named."""
    blueprint = blueprint_from_files(run_file)
    the_plan = blueprint.plan
    rig = blueprint.configuration.rig
    position_s = the_plan.position_s(rig.recorder)
    needed, scenes = _needed_by_scenes(scene_files, the_plan, checks=checks)
    duration_s = the_plan.campaign_s(len(needed), rig.recorder)
    sentinel_passes = the_plan.drift.passes(len(needed), position_s)
    stop_hz = the_plan.excitation.band_hz[1]
    top_hz = top_hz_of(scenes, the_plan.excitation.sample_rate_hz, stop_hz) if scenes else stop_hz
    grids = grid_advice(the_plan.position_mm, position_s, top_hz=top_hz, waves=waves)
    instruments = _instruments(rig, blueprint.configuration.run)
    size = blueprint.bank_header().file_bytes
    schedules = compared(blueprint)
    free = shutil.disk_usage(run_file.resolve().parent).free
    finish = datetime.now().astimezone() + timedelta(seconds=duration_s)
    facts = {
        "positions": the_plan.positions,
        "positions_needed": len(needed),
        "actuators": the_plan.actuators,
        "schedule": schedule_name(the_plan),
        "records": the_plan.positions * the_plan.records,
        "taps": the_plan.taps,
        "band_hz": list(the_plan.excitation.band_hz),
        "averages": the_plan.excitation.averages,
        "sentinel_passes": sentinel_passes,
        "duration_s": duration_s,
        "hours": duration_s / 3600.0,
        "finish_at": finish.isoformat(timespec="minutes"),
        "bank_bytes": size,
        "disk_free_bytes": free,
        "snr_db": ASSUMED_SNR_DB,
        "schedules": [asdict(one) for one in schedules],
        "awaits_trial": blueprint.configuration.run.awaits_trial,
        "grid": {"top_hz": top_hz, **asdict(waves), "enough": [asdict(one) for one in grids]},
        "instruments": instruments,
        "plan_sha256": the_plan.sha256,
    }
    if as_json:
        print(json.dumps(facts))
        return
    start, stop = the_plan.excitation.band_hz
    say(f"positions   {the_plan.positions}, {the_plan.actuators} actuators, {facts['records']} records")
    say(f"sweeps      {schedule_name(the_plan)}, {start:g}-{stop:g} Hz, {the_plan.excitation.amplitude_v:g} V")
    if scenes:
        all_s = the_plan.campaign_s(the_plan.positions, rig.recorder)
        say(f"scenes      need {len(needed)} of {the_plan.positions} positions; all of them: {hours(all_s)}")
    say(f"duration    {hours(duration_s)}; started now it finishes {finish:%a %d %b %H:%M}")
    if sentinel_passes:
        say(f"sentinel    measured again {sentinel_passes} times, {hours(sentinel_passes * position_s)} of that")
    if blueprint.configuration.run.awaits_trial:
        say("trial       a check position is measured by every schedule first, and decides between them")
    for one in schedules:
        say(
            f"schedule    {one.name}: {hours(one.seconds)}; expected error {one.additive_db:.1f} dB, "
            f"{one.proportional_db:.1f} dB where noise grows with the signal"
        )
    say(f"            at {ASSUMED_SNR_DB:g} dB signal-to-noise ratio of one actuator; another one moves all alike")
    for line in advice_lines(grids, top_hz=top_hz, waves=waves, planned_s=the_plan.positions * position_s):
        say(line)
    say(f"bank        {size / 1e6:.0f} MB; {free / 1e9:.1f} GB free here")
    for instrument in instruments:
        say(f"instrument  {instrument}")
    say(f"plan        {the_plan.sha256[:16]}; within all limits")


def _needed_by_scenes(files: Sequence[Path], plan: Plan, *, checks: bool) -> tuple[Collection[int], list[Scene]]:
    """Positions that some scenes need, and the scenes; all positions where there is none."""
    if not files:
        return range(plan.positions), []
    from wavefocus.config.scene import load_scene  # with them comes what renders
    from wavefocus.scene_positions import needed_by

    return needed_by(files, plan.position_mm, checks=checks), [load_scene(file) for file in files]


def _instruments(rig: RigConfig, run: RunConfig) -> list[str]:
    """Names of the instruments: virtual ones are asked; real ones are left alone, for a dry run needs none."""
    if not rig.is_virtual:
        mirror, recorder, player = rig.mirror, rig.recorder, rig.player
        where = f", gRPC Device Server {recorder.address}" if recorder.address else ""
        return [
            f"mirror {mirror.driver} at {mirror.port}, not asked",
            f"recorder {recorder.driver} {recorder.device}{where}, not asked",
            f"player {player.driver} {player.device}, {player.outputs} outputs, not asked",
            "wavefocus doctor asks them all",
        ]
    with open_setup(rig, run) as setup:
        return list(names_of(setup.instruments))
