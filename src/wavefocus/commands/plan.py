"""``wavefocus plan``: the dry run."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from wavefocus.acquisition.plan import ASSUMED_SNR_DB, GEL_SPEED_M_S, GROUP, Expectation, Plan, expect, schedule_name
from wavefocus.acquisition.setup import names_of
from wavefocus.acquisition.wording import hours
from wavefocus.calibration.blas import one_blas_thread
from wavefocus.campaign.blueprint import Blueprint, blueprint_from_files, blueprint_of, ringing_of
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import RunConfig
from wavefocus.console import answer
from wavefocus.rendering.greens.interpolation.needed_grid import needed_grid, wave_number_rad_mm
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rig.setup import open_setup
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.rendering.scene.model import Scene


def plan(
    run_file: Path,
    scene_files: Sequence[Path] = (),
    waves: Waves | None = None,
    *,
    checks: bool = True,
    allow_large: bool = False,
    as_json: bool,
) -> None:
    """Walk the plan without playing anything and report time, size and limits; for some scenes alone if named."""
    blueprint = blueprint_from_files(run_file)
    the_plan = blueprint.plan
    waves = waves or Waves()
    rig = blueprint.configuration.rig
    position_s = the_plan.position_s(rig.recorder)
    needed, scenes = _needed_by_scenes(scene_files, the_plan, checks=checks, allow_large=allow_large)
    rows = np.array(sorted(needed), dtype=np.int64)
    second_looks = the_plan.second_looks(rows, waves.speed_m_s)
    sentinel_passes = the_plan.drift.passes(len(needed) + second_looks, position_s)
    duration_s = (len(needed) + second_looks + sentinel_passes) * position_s
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
        "grid": {"top_hz": top_hz, **asdict(waves), "enough": [asdict(one) for one in grids]},
        "instruments": instruments,
        "plan_sha256": the_plan.sha256,
    }
    lines: list[str] = []
    if (rings := ringing_of(blueprint)) is not None:
        facts["ringing"] = {"seconds": rings.seconds, "taps": rings.taps, "enough": not rings.advice}
    start, stop = the_plan.excitation.band_hz
    lines.append(f"positions   {the_plan.positions}, {the_plan.actuators} actuators, {facts['records']} records")
    lines.append(f"sweeps      {schedule_name(the_plan)}, {start:g}-{stop:g} Hz, {the_plan.excitation.amplitude_v:g} V")
    if scenes:
        all_s = the_plan.campaign_s(the_plan.order, rig.recorder, waves.speed_m_s)
        lines.append(f"scenes      need {len(needed)} of {the_plan.positions} positions; all of them: {hours(all_s)}")
    lines.append(f"duration    {hours(duration_s)}; started now it finishes {finish:%a %d %b %H:%M}")
    if second_looks:
        lines.append(
            f"second look {second_looks} positions that no neighbour can judge are measured twice, "
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
    lines += advice_lines(grids, top_hz=top_hz, waves=waves, planned_s=the_plan.positions * position_s)
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
    files: Sequence[Path], plan: Plan, *, checks: bool, allow_large: bool
) -> tuple[Collection[int], list[Scene]]:
    """Positions that some scenes need, and the scenes; all positions where there is none."""
    if not files:
        return range(plan.positions), []
    from wavefocus.campaign.blueprint import needed_by
    from wavefocus.rendering.scene.model import load_scene  # with them comes what renders
    from wavefocus.rendering.scene.size import check_scene_size

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


GEL_ATTENUATION_DB_PER_CM = 3.8
"""Loss of a gel plate as in the paper."""
EMITTED_SHARE = 0.999
"""A scene's band ends where this share of what its signals emit lies below."""
BANK_ERROR_DB = -60.0
KINDS: tuple[tuple[str, Literal["square", "hexagonal"]], ...] = (
    ("bicubic", "square"),
    ("kernel", "square"),
    ("kernel", "hexagonal"),
)


@dataclass(frozen=True, slots=True)
class Waves:
    """Relative rms `error` allowed between the positions at the band's upper end, 0 to 1, and the plate's waves."""

    error: float = 0.05
    speed_m_s: float = GEL_SPEED_M_S
    attenuation_db_per_cm: float = GEL_ATTENUATION_DB_PER_CM


@dataclass(frozen=True, slots=True)
class GridAdvice:
    """The widest grid that keeps to the error: its kind, the positions on the plan's area, and the time they take."""

    interpolation: str
    lattice: str
    spacing_mm: float
    positions: int
    duration_s: float


def grid_advice(
    position_mm: NDArray[np.float64],
    position_s: float,
    *,
    top_hz: float,
    waves: Waves,
) -> tuple[GridAdvice, ...]:
    """Find the widest grids that keep the interpolation within an error, on the area that a plan covers.

    Raises InputError: A figure is out of range, or no grid keeps to the error.
    """
    area_mm2 = len(position_mm) * PositionGrid(position_mm).spacing_mm ** 2 or 1.0
    wavenumber = wave_number_rad_mm(top_hz, waves.speed_m_s, waves.attenuation_db_per_cm)
    advice = []
    for kind, lattice in KINDS:
        with one_blas_thread():  # thousands of small matrices
            grid = needed_grid(wavenumber, area_mm2, waves.error, lattice=lattice, kind=kind, noise_db=BANK_ERROR_DB)
        advice.append(GridAdvice(kind, lattice, grid.spacing_mm, grid.positions, grid.positions * position_s))
    return tuple(advice)


def top_hz_of(scenes: Sequence[Scene], sample_rate_hz: float, stop_hz: float) -> float:
    """Upper end of the band that scenes emit: below it lies 99.9 % of their signals' energy."""
    highest_hz = 0.0
    for scene in scenes:
        for source in scene.sources:
            power = np.square(np.abs(np.fft.rfft(source.signal.samples(sample_rate_hz))))
            upto = np.cumsum(power)
            share = np.searchsorted(upto, EMITTED_SHARE * upto[-1]) / max(len(power) - 1, 1)
            highest_hz = max(highest_hz, float(share) * sample_rate_hz / 2)
    return min(highest_hz, stop_hz) or stop_hz


def advice_lines(advice: Sequence[GridAdvice], *, top_hz: float, waves: Waves, planned_s: float) -> list[str]:
    """The advice for people, a line per grid."""
    lines = [
        f"grid        enough for {100 * waves.error:g} % between the positions at {top_hz:.0f} Hz, "
        f"at {waves.speed_m_s:g} m/s and {waves.attenuation_db_per_cm:g} dB/cm:"
    ]
    for one in advice:
        saved_s = planned_s - one.duration_s
        change = f"{hours(saved_s)} less" if saved_s >= 0 else f"{hours(-saved_s)} more"
        lines.append(
            f"            {one.interpolation}, {one.lattice}, {one.spacing_mm:.1f} mm: {one.positions} positions, "
            f"{hours(one.duration_s)} ({change})"
        )
    return lines
