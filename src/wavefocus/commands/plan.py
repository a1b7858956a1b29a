"""``wavefocus plan``: the dry run."""

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from wavefocus.acquisition.plan import schedule_name
from wavefocus.acquisition.setup import names_of
from wavefocus.acquisition.wording import finish_time, hours
from wavefocus.campaign.blueprint import blueprint_from_files
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import RunConfig
from wavefocus.console import answer
from wavefocus.rig.setup import open_setup


def plan(run_file: Path, scene_files: Sequence[Path] = (), *, details: bool = False, as_json: bool) -> None:
    """Walk the plan without playing anything and report time, size and limits; for some scenes alone if named."""
    blueprint = blueprint_from_files(run_file)
    the_plan, rig = blueprint.plan, blueprint.configuration.rig
    rows = every = np.arange(the_plan.positions)
    if scene_files:
        from wavefocus.campaign.blueprint import needed_by  # with it comes what renders

        rows = np.array(sorted(needed_by(scene_files, blueprint)), np.int64)
    position_s = the_plan.position_s(rig.recorder)
    second_looks = the_plan.second_looks(rows)
    duration_s = the_plan.campaign_s(rows, rig.recorder)
    facts: dict[str, Any] = {
        "positions": the_plan.positions,
        "positions_needed": len(rows),
        "check_positions": len(the_plan.check_rows),
        "actuators": the_plan.actuators,
        "schedule": schedule_name(the_plan),
        "records": the_plan.looks(*range(the_plan.positions)) * the_plan.records,
        "taps": the_plan.taps,
        "band_hz": list(the_plan.excitation.band_hz),
        "averages": the_plan.excitation.averages,
        "second_looks": second_looks,
        "sentinel_passes": the_plan.drift.passes(len(rows) + second_looks, position_s),
        "duration_s": duration_s,
        "hours": duration_s / 3600.0,
        "finish_at": finish_time(duration_s, datetime.now(UTC)).isoformat(timespec="minutes"),
        "bank_bytes": blueprint.bank_header().file_bytes,
        "disk_free_bytes": shutil.disk_usage(run_file.resolve().parent).free,
        "instruments": _instruments(rig, blueprint.configuration.run),
        "plan_sha256": the_plan.sha256,
    }
    lines = list(_lines(facts, position_s, the_plan.excitation.amplitude_v))
    if scene_files:
        all_s = the_plan.campaign_s(every, rig.recorder)
        needed = f"scenes      need {len(rows)} of {the_plan.positions} positions; all of them: {hours(all_s)}"
        lines.insert(1, (needed, False))
    if as_json:
        print(json.dumps({**facts, "lines": [line for line, _ in lines]}))
        return
    for line, in_detail in lines:
        if details or not in_detail:
            answer(line)


def _lines(facts: Mapping[str, Any], position_s: float, amplitude_v: float) -> Iterator[tuple[str, bool]]:
    """Hours, bytes, end and limits; and, for `--details` alone (True), sweeps, sentinel and instruments."""
    finish, (start_hz, stop_hz) = datetime.fromisoformat(facts["finish_at"]), facts["band_hz"]
    yield f"positions   {facts['positions']}, {facts['actuators']} actuators, {facts['records']} records", False
    if count := facts["check_positions"]:
        yield f"checks      {count} of the positions lie off the grid and only judge what is interpolated", False
    if count := facts["second_looks"]:
        twice = f"second look {count} positions that the others cannot judge are measured twice"
        yield f"{twice}, {hours(count * position_s)} of that", False
    yield f"duration    {hours(facts['duration_s'])}; started now it finishes {finish:%a %d %b %H:%M}", False
    yield f"bank        {facts['bank_bytes'] / 1e6:.0f} MB; {facts['disk_free_bytes'] / 1e9:.1f} GB free here", False
    yield f"sweeps      {facts['schedule']}, {start_hz:g}-{stop_hz:g} Hz, {amplitude_v:g} V", True
    if count := facts["sentinel_passes"]:
        yield f"sentinel    measured again {count} times, {hours(count * position_s)} of the duration", True
    for instrument in facts["instruments"]:
        yield f"instrument  {instrument}", True
    yield f"plan        {facts['plan_sha256'][:16]}; within all limits", False


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
        return list(names_of(setup).values())
