"""``wavefocus plan``: the dry run."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from wavefocus.acquisition.plan import ASSUMED_SNR_DB, GEL_SPEED_M_S, GROUP, Expectation, expect, schedule_name
from wavefocus.acquisition.setup import names_of
from wavefocus.acquisition.wording import finish_time, hours
from wavefocus.campaign.blueprint import Blueprint, blueprint_from_files, blueprint_of, ringing_of
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import RunConfig
from wavefocus.configuration import check_rows
from wavefocus.console import answer
from wavefocus.rig.setup import open_setup
from wavefocus.storage.errors import InputError


def plan(
    run_file: Path,
    scene_files: Sequence[Path] = (),
    *,
    speed_m_s: float = GEL_SPEED_M_S,
    checks: bool = True,
    allow_large: bool = False,
    as_json: bool,
) -> None:
    """Walk the plan without playing anything and report time, size and limits; for some scenes alone if named."""
    blueprint = blueprint_from_files(run_file)
    the_plan = blueprint.plan
    rig = blueprint.configuration.rig
    position_s = the_plan.position_s(rig.recorder)
    needed = _needed_by_scenes(scene_files, blueprint, checks=checks, allow_large=allow_large)
    rows = np.array(sorted(needed), dtype=np.int64)
    checks_off_grid = check_rows(blueprint.configuration)
    second_looks = the_plan.second_looks(rows, speed_m_s)
    sentinel_passes = the_plan.drift.passes(len(needed) + second_looks, position_s)
    duration_s = (len(needed) + second_looks + sentinel_passes) * position_s
    instruments = _instruments(rig, blueprint.configuration.run)
    size = blueprint.bank_header().file_bytes
    schedules = compared(blueprint)
    free = shutil.disk_usage(run_file.resolve().parent).free
    finish = finish_time(duration_s, datetime.now(UTC))
    facts = {
        "positions": the_plan.positions,
        "positions_needed": len(needed),
        "check_positions": len(checks_off_grid),
        "actuators": the_plan.actuators,
        "schedule": schedule_name(the_plan),
        "records": the_plan.positions * the_plan.records,
        "taps": the_plan.taps,
        "band_hz": list(the_plan.excitation.band_hz),
        "averages": the_plan.excitation.averages,
        "second_looks": second_looks,
        "sentinel_passes": sentinel_passes,
        "duration_s": duration_s,
        "hours": duration_s / 3600.0,
        "finish_at": finish.isoformat(timespec="minutes"),
        "bank_bytes": size,
        "disk_free_bytes": free,
        "snr_db": ASSUMED_SNR_DB,
        "schedules": [asdict(one) for one in schedules],
        "awaits_trial": blueprint.configuration.run.awaits_trial,
        "instruments": instruments,
        "plan_sha256": the_plan.sha256,
    }
    lines: list[str] = []
    if (rings := ringing_of(blueprint)) is not None:
        facts["ringing"] = {"seconds": rings.seconds, "taps": rings.taps, "enough": not rings.advice}
    start, stop = the_plan.excitation.band_hz
    lines.append(f"positions   {the_plan.positions}, {the_plan.actuators} actuators, {facts['records']} records")
    if len(checks_off_grid):
        lines.append(
            f"checks      {len(checks_off_grid)} of the positions lie off the grid and only judge what is interpolated"
        )
    lines.append(f"sweeps      {schedule_name(the_plan)}, {start:g}-{stop:g} Hz, {the_plan.excitation.amplitude_v:g} V")
    if scene_files:
        all_s = the_plan.campaign_s(the_plan.order, rig.recorder, speed_m_s)
        lines.append(f"scenes      need {len(needed)} of {the_plan.positions} positions; all of them: {hours(all_s)}")
    lines.append(f"duration    {hours(duration_s)}; started now it finishes {finish:%a %d %b %H:%M}")
    if second_looks:
        lines.append(
            f"second look {second_looks} positions that the others cannot judge are measured twice, "
            f"{hours(second_looks * position_s)} of that"
        )
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
    lines.append(f"bank        {size / 1e6:.0f} MB; {free / 1e9:.1f} GB free here")
    lines += [f"instrument  {instrument}" for instrument in instruments]
    if rings is not None and rings.advice:
        lines.append(f"warning     {rings.advice}")
    lines.append(f"plan        {the_plan.sha256[:16]}; within all limits")
    if as_json:
        print(json.dumps({**facts, "lines": lines}))
        return
    for line in lines:
        answer(line)


def _needed_by_scenes(
    files: Sequence[Path], blueprint: Blueprint, *, checks: bool, allow_large: bool
) -> Collection[int]:
    """Positions that some scenes need; all positions without scenes."""
    plan = blueprint.plan
    if not files:
        return range(plan.positions)
    from wavefocus.campaign.blueprint import needed_by
    from wavefocus.rendering.scene.model import load_scene  # with them comes what renders
    from wavefocus.rendering.scene.size import check_scene_size

    for file in files:
        scene = load_scene(file, allow_large=allow_large)
        try:
            rate_hz = plan.excitation.sample_rate_hz
            check_scene_size(scene, sample_rate_hz=rate_hz, taps=plan.taps, actuators=plan.actuators)
        except InputError as wrong:
            raise InputError(f"{file}: {wrong}") from None
    return needed_by(files, blueprint, checks=checks, allow_large=allow_large)


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


def compared(blueprint: Blueprint) -> list[Expectation]:
    """What may be expected of sequential capture, of staggered capture and of groups, the run's own values kept."""
    configuration = blueprint.configuration
    actuators = blueprint.plan.actuators
    wanted: list[dict[str, object]] = [{"excitation": "sequential"}, {"excitation": "staggered", "groups": 1}]
    groups = {-(-actuators // GROUP), configuration.run.capture.groups} - {1}
    wanted += [{"excitation": "staggered", "groups": count} for count in sorted(groups)]
    found = []
    for changes in wanted:
        capture = configuration.run.capture.model_copy(update=changes)
        run = configuration.run.model_copy(update={"capture": capture})
        try:
            plan = blueprint_of(replace(configuration, run=run)).plan
        except InputError:
            continue
        found.append(expect(plan, configuration.rig.recorder))
    return found
