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
from acquisition.engine.roles import names_of
from acquisition.schedule.expectation import ASSUMED_SNR_DB, schedule_name
from acquisition.schedule.plan import Plan
from config.rig import RigConfig
from config.run import RunConfig
from storage.errors import InputError
from wavefocus.campaign.blueprint import blueprint_from_files
from wavefocus.campaign.comparison import compared
from wavefocus.campaign.grid_advice import Waves, advice_lines, grid_advice, top_hz_of
from wavefocus.console import answer
from wavefocus.rig.compose import open_setup

if TYPE_CHECKING:
    from rendering.scene.model import Scene


def plan(
    run_file: Path,
    scene_files: Sequence[Path] = (),
    waves: Waves = Waves(),  # noqa: B008  # frozen
    *,
    checks: bool = True,
    allow_large: bool = False,
    as_json: bool,
) -> None:
    """Walk the plan without playing anything and tell what it would take; for some scenes alone if named."""
    blueprint = blueprint_from_files(run_file)
    the_plan = blueprint.plan
    rig = blueprint.configuration.rig
    position_s = the_plan.position_s(rig.recorder)
    needed, scenes = _needed_by_scenes(scene_files, the_plan, checks=checks, allow_large=allow_large)
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
    lines: list[str] = []
    start, stop = the_plan.excitation.band_hz
    lines.append(f"positions   {the_plan.positions}, {the_plan.actuators} actuators, {facts['records']} records")
    lines.append(f"sweeps      {schedule_name(the_plan)}, {start:g}-{stop:g} Hz, {the_plan.excitation.amplitude_v:g} V")
    if scenes:
        all_s = the_plan.campaign_s(the_plan.positions, rig.recorder)
        lines.append(f"scenes      need {len(needed)} of {the_plan.positions} positions; all of them: {hours(all_s)}")
    lines.append(f"duration    {hours(duration_s)}; started now it finishes {finish:%a %d %b %H:%M}")
    if sentinel_passes:
        lines.append(
            f"sentinel    measured again {sentinel_passes} times, {hours(sentinel_passes * position_s)} of that"
        )
    if blueprint.configuration.run.awaits_trial:
        lines.append("trial       a check position is measured by every schedule first, and decides between them")
    for one in schedules:
        lines.append(
            f"schedule    {one.name}: {hours(one.seconds)}; expected error {one.additive_db:.1f} dB, "
            f"{one.proportional_db:.1f} dB where noise grows with the signal"
        )
    lines.append(
        f"            at {ASSUMED_SNR_DB:g} dB signal-to-noise ratio of one actuator; another one moves all alike"
    )
    lines += advice_lines(grids, top_hz=top_hz, waves=waves, planned_s=the_plan.positions * position_s)
    lines.append(f"bank        {size / 1e6:.0f} MB; {free / 1e9:.1f} GB free here")
    lines += [f"instrument  {instrument}" for instrument in instruments]
    lines.append(f"plan        {the_plan.sha256[:16]}; within all limits")
    if as_json:
        print(json.dumps({**facts, "lines": lines}))
        return
    for line in lines:
        answer(line)


def _needed_by_scenes(
    files: Sequence[Path], plan: Plan, *, checks: bool, allow_large: bool
) -> tuple[Collection[int], list[Scene]]:
    """Positions that some scenes need, and the scenes; all positions where there is none."""
    if not files:
        return range(plan.positions), []
    from rendering.scene.loading import load_scene  # with them comes what renders
    from rendering.scene.size import check_scene_size
    from wavefocus.campaign.scene_positions import needed_by

    scenes = []
    for file in files:
        scene = load_scene(file, allow_large=allow_large)
        try:
            rate_hz = plan.excitation.sample_rate_hz
            check_scene_size(scene, sample_rate_hz=rate_hz, taps=plan.taps, actuators=plan.actuators)
        except InputError as wrong:
            raise InputError(f"{file}: {wrong}") from None
        scenes.append(scene)
    return needed_by(files, plan.position_mm, checks=checks, allow_large=allow_large), scenes


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
