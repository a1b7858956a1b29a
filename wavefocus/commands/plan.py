"""``wavefocus plan``: the dry run."""

from __future__ import annotations

import json
import shutil
from datetime import datetime, timedelta
from pathlib import Path

from acquisition.durations import hours
from acquisition.roles import names_of
from wavefocus.compose import blueprint_from_files, open_setup
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import RunConfig
from wavefocus.console import say


def plan(run_file: Path, *, as_json: bool) -> None:
    """Walk the plan without playing anything and tell what it would take."""
    blueprint = blueprint_from_files(run_file)
    the_plan = blueprint.plan
    rig = blueprint.configuration.rig
    duration_s = the_plan.positions * the_plan.position_s(rig.recorder)
    instruments = _instruments(rig, blueprint.configuration.run)
    size = blueprint.bank_header().file_bytes
    free = shutil.disk_usage(run_file.resolve().parent).free
    finish = datetime.now().astimezone() + timedelta(seconds=duration_s)
    facts = {
        "positions": the_plan.positions,
        "actuators": the_plan.actuators,
        "records": the_plan.positions * the_plan.actuators,
        "taps": the_plan.taps,
        "band_hz": list(the_plan.excitation.band_hz),
        "averages": the_plan.excitation.averages,
        "duration_s": duration_s,
        "hours": duration_s / 3600.0,
        "finish_at": finish.isoformat(timespec="minutes"),
        "bank_bytes": size,
        "disk_free_bytes": free,
        "instruments": instruments,
        "plan_sha256": the_plan.sha256,
    }
    if as_json:
        print(json.dumps(facts))
        return
    start, stop = the_plan.excitation.band_hz
    say(f"positions   {the_plan.positions}, {the_plan.actuators} actuators, {facts['records']} records")
    say(
        f"sweeps      {the_plan.excitation.averages} x {the_plan.excitation.duration_s:g} s, {start:g}-{stop:g} Hz, "
        f"{the_plan.excitation.amplitude_v:g} V"
    )
    say(f"duration    {hours(duration_s)}; started now it finishes {finish:%a %d %b %H:%M}")
    say(f"bank        {size / 1e6:.0f} MB; {free / 1e9:.1f} GB free here")
    for instrument in instruments:
        say(f"instrument  {instrument}")
    say(f"plan        {the_plan.sha256[:16]}; within all limits")


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
