"""Drives of a scene while it is edited, to -60 dB, and the figures of its foci."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from wavefocus.acquisition.wording import hours
from wavefocus.calibration.numerics import evenly_spread
from wavefocus.config.scene import Output
from wavefocus.gui.scene.calculation import DriveResult, FocusFigures, ReachedLevel, interpolate_frame
from wavefocus.gui.surface import path_line
from wavefocus.rendering.arrays import Float32Array, Float64Array, Int64Array
from wavefocus.rendering.drive.coil_limits import DriveLimits, Limiting, levels_of, limit_drive
from wavefocus.rendering.drive.rendering import SceneRenderer, render_with_report
from wavefocus.rendering.field.crosstalk import PathResponses
from wavefocus.rendering.field.focus_figures import FOCUS_RADIUS_MM, FocusInstant
from wavefocus.rendering.field.metrics import focus_spot, grid_spacing_mm
from wavefocus.rendering.field.quiet_levels import quiet_levels
from wavefocus.rendering.greens.regularisation import focus_gains, saturation_threshold
from wavefocus.rendering.greens.source import refusal
from wavefocus.rendering.report.movie import Foci
from wavefocus.rendering.scene.model import Scene
from wavefocus.rendering.scene.scene_rows import scene_rows
from wavefocus.rendering.scene.size import scene_size
from wavefocus.rendering.scene.trajectory_path import TrajectoryPath
from wavefocus.storage.bank.reading import Bank
from wavefocus.storage.drive_file import Drive
from wavefocus.storage.errors import InputError

OnProgress = Callable[[int, int], None]

TOLERANCE_DB = -60.0
MAX_DRIVE_BYTES = 128 * 2**20
MAX_S = 600.0
MAX_GAINS = 200
MAX_PATH_POINTS = 400
_LISTED = 12
MAX_FIGURES = 8
MAX_CROSSTALK_POINTS = 24
MAX_CROSSTALK_SOURCES = 4


@dataclass(frozen=True, slots=True, eq=False)
class Rendered:
    """A limited drive, perhaps only the beginning of `lasts_s` seconds; `limiting` says what the limits did."""

    drive: Drive
    limiting: Limiting
    warnings: tuple[str, ...]
    lasts_s: float


def render_while_edited(
    scene: Scene, bank: Bank, limits: DriveLimits, on_progress: OnProgress, most_bytes: int = MAX_DRIVE_BYTES
) -> Rendered:
    """Render a scene to -60 dB and limit it.

    scene: Its own limits are ignored.
    limits: Limits of every actuator.
    on_progress: Receives blocks done and blocks in all; what it raises ends the render.
    most_bytes: Of longer drives only the beginning is rendered.

    Raises InputError: The scene does not fit the bank, or lasts too long.
    """
    free = Output(interpolation=scene.output.interpolation, most_energy=scene.output.most_energy)
    plain = replace(scene, output=free)
    lasts_s = scene_size(scene, sample_rate_hz=float(bank.sample_rate_hz), taps=1, actuators=1).seconds
    if lasts_s > MAX_S:
        length = hours(min(lasts_s, sys.float_info.max))
        raise InputError(
            f"the scene lasts {length}; while it is edited, scenes of up to {hours(MAX_S)} are calculated."
            " Shorten it, or save the drive, which may last longer"
        )
    lasts_s += (bank.taps - 1) / bank.sample_rate_hz
    most = most_bytes // (8 * bank.actuators)
    if lasts_s * bank.sample_rate_hz > most:
        drive = _beginning(plain, bank, most, on_progress)
        warnings: tuple[str, ...] = (
            f"the drives last {hours(lasts_s)}; only their first {drive.drive_v.shape[1] / bank.sample_rate_hz:.0f} s"
            " are shown here, with their levels and limits; saving and playing use all of them",
        )
    else:
        drive, report = render_with_report(plain, bank, tolerance_db=TOLERANCE_DB, on_progress=on_progress)
        lasts_s, warnings = drive.drive_v.shape[1] / bank.sample_rate_hz, report.warnings
    limiting = limit_drive(drive.drive_v, drive.sample_rate_hz, limits)
    return Rendered(replace(drive, scale=limiting.scale), limiting, warnings, lasts_s)


def summarise(
    number: int, scene: Scene, bank: Bank, rendered: Rendered, limits: DriveLimits, resistance_ohm: float | None
) -> DriveResult:
    """Gather what the window shows of the drives."""
    drive = rendered.drive
    foci = Foci.of(drive)
    drive_v, position_mm = drive.drive_v, np.asarray(bank.position_mm, np.float64)
    gain_s, gain = _gains(scene, bank, drive)
    snaps = [0.0]
    for index, source in enumerate(scene.sources):
        own = drive.focus_source == index
        count = np.count_nonzero(own)
        if isinstance(source.path, TrajectoryPath):
            points = source.path.foci(0.0)[1][:count]
        else:
            points = source.path.point_at(np.minimum(np.arange(count) * source.step_mm, source.path.length_mm))
        snaps.append(float(np.hypot(*(points - position_mm[drive.focus_position[own]]).T).max(initial=0.0)))
    return DriveResult(
        number=number,
        drive_v=drive_v.astype(np.float32),
        sample_rate_hz=drive.sample_rate_hz,
        start_s=drive.start_s,
        lasts_s=rendered.lasts_s,
        method=drive.method,
        limiting=rendered.limiting,
        limits=limits,
        resistance_ohm=resistance_ohm,
        peak_v=np.maximum(drive_v.max(axis=1), -drive_v.min(axis=1)),
        rms_v=levels_of(drive_v, drive.sample_rate_hz).rms_v,
        omitted_bound=drive.omitted_bound if math.isfinite(drive.omitted_bound) else math.nan,
        gain_s=gain_s,
        gain=gain,
        focus_s=foci.start_s,
        focus_stop_s=foci.stop_s,
        focus_mm=position_mm[foci.position],
        paths_mm=[path_line(source.path, MAX_PATH_POINTS) for source in scene.sources],
        snap_mm=max(snaps),
        warnings=rendered.warnings,
        unit=drive.drive_unit,
        levels=tuple(
            ReachedLevel(one.track.name, one.track.level_db, one.reached_db) for one in quiet_levels(drive, bank)
        ),
    )


def missing_rows(scene: Scene, bank: Bank) -> tuple[int, ...]:
    """Return positions along the paths of a scene without a measurement; none where the paths leave the grid."""
    try:
        needed = scene_rows(scene, np.asarray(bank.position_mm, np.float64)).path
    except InputError:
        return ()
    status = bank.status
    return tuple(int(row) for row in needed if refusal(int(status[row])))


def missing_text(rows: tuple[int, ...], why: str) -> str:
    """Return a message about positions that a scene needs."""
    listed = ", ".join(map(str, rows[:_LISTED])) + (f" and {len(rows) - _LISTED} more" if len(rows) > _LISTED else "")
    return (
        f"the bank has no measurement at {len(rows)} positions on the scene's paths: {listed}. Measure them, or move"
        f" the path ({why}); results are shown as soon as they are measured"
    )


def _beginning(scene: Scene, bank: Bank, most: int, on_progress: OnProgress) -> Drive:
    """The first samples of a drive that is not made as a whole."""
    renderer = SceneRenderer(scene, bank, tolerance_db=TOLERANCE_DB)
    drive_v, filled = np.zeros((bank.actuators, min(most, renderer.shape[1]))), 0
    for block in renderer.unlimited_blocks():
        taken = block[:, : drive_v.shape[1] - filled]
        drive_v[:, filled : filled + taken.shape[1]] = taken
        filled += taken.shape[1]
        on_progress(filled, drive_v.shape[1])
        if filled == drive_v.shape[1]:
            break
    sampled = renderer.sampled
    sample, position, source = sampled.foci
    there = sample < round(sampled.start_s * bank.sample_rate_hz) + filled
    return Drive(
        drive_v, bank.sample_rate_hz, sampled.start_s, sampled.method, 1.0, math.inf, sample[there], position[there],
        source[there], bank.drive_unit,
    )  # fmt: skip


def _gains(scene: Scene, bank: Bank, drive: Drive) -> tuple[Float64Array, Float64Array]:
    """Focus instants chosen, and n(x) of eq. (15) at each."""
    order = np.argsort(drive.focus_sample, kind="stable")
    chosen = order[evenly_spread(len(order), MAX_GAINS)]
    threshold = saturation_threshold(scene.regularisation, bank)
    positions, of_focus = np.unique(drive.focus_position[chosen], return_inverse=True)
    gain = focus_gains(bank, positions.tolist(), threshold)[of_focus]
    return drive.focus_sample[chosen] / drive.sample_rate_hz, gain


def focus_figures(
    number: int, looked: Sequence[FocusInstant], field: Float32Array, field_rate_hz: float, rows: Int64Array,
    bank: Bank, scene: Scene, drive: Drive, check: Callable[[], None],
) -> FocusFigures:  # fmt: skip
    """Compute the figures of some of the foci.

    number: Of the request.
    looked: As `wavefocus.rendering.field.foci.loudest_instants` returns them.
    field, float32 (samples, positions): The beginning of the predicted field; figures beyond its end are NaN.
    field_rate_hz: Its rate.
    rows, int64 (positions,): Its positions' bank rows.
    bank, scene, drive: Of the field.
    check: Called between the figures; what it raises ends the work.
    """
    instants = [looked[index] for index in evenly_spread(len(looked), MAX_FIGURES)]
    time_s = np.array([one.sample for one in instants]) / drive.sample_rate_hz
    position_mm = np.asarray(bank.position_mm, np.float64)
    there = position_mm[rows]
    peak, off_mm, width_mm, artefact_db = np.full((4, len(instants)), np.nan)
    spacing_mm = grid_spacing_mm(there) if len(there) > 1 else None
    for index, place in enumerate(((time_s - drive.start_s) * field_rate_hz).tolist()):
        check()
        if place > len(field) - 1:
            continue
        point = position_mm[instants[index].row]
        if found := focus_spot(there, interpolate_frame(field, place), point, FOCUS_RADIUS_MM, spacing_mm):
            peak[index], off_mm[index] = abs(found.value), found.off_mm
            width_mm[index], artefact_db[index] = found.width_mm, found.artefact_db
    crosstalk = []
    for source in range(min(len(scene.sources), MAX_CROSSTALK_SOURCES)):
        check()
        ratio = _crosstalk(scene, source, bank, drive)
        if math.isfinite(ratio):
            crosstalk.append((source, ratio))
    return FocusFigures(number, time_s, peak, off_mm, width_mm, artefact_db, tuple(crosstalk))


def _crosstalk(scene: Scene, index: int, bank: Bank, drive: Drive) -> float:
    """Crosstalk along the middle of a source's path, as a ratio of amplitudes; NaN where it has but one point.

    Every path point emits the source's signal where it emits per point, else one impulse.
    """
    source = scene.sources[index]
    rows: Sequence[int] = drive.focus_position[drive.focus_source == index].tolist()
    if len(rows) < 2 or source.speed_mm_s <= 0:
        return math.nan
    begin = (len(rows) - min(len(rows), MAX_CROSSTALK_POINTS)) // 2
    signal = source.signal.samples(bank.sample_rate_hz) if source.emission == "per_point" else None
    try:
        responses = PathResponses(bank, rows[begin : begin + MAX_CROSSTALK_POINTS], signal, scene.regularisation)
    except InputError:
        return math.nan  # the emission is too long to be compared point by point
    return math.sqrt(responses.energy_ratio(source.speed_mm_s, source.step_mm))
