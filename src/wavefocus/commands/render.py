"""``wavefocus render``: a scene becomes drive signals."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.console import progress, say, working_on
from wavefocus.drives import naming, render_by_options
from wavefocus.input_files import input_files
from wavefocus.options import RenderOptions
from wavefocus.rendering.drive.coil_limits import dynamic_range_db, peaks
from wavefocus.rendering.drive.rendering import SceneRenderer
from wavefocus.rendering.drive.wav import Interface, stream_wav
from wavefocus.rendering.field.at_foci import predicted_focus_peak
from wavefocus.rendering.field.prediction import field_unit
from wavefocus.rendering.field.quiet_levels import QuietLevel, levels_json, quiet_levels, rendered_levels
from wavefocus.rendering.report.render_report import RenderReport
from wavefocus.rendering.scene.model import Scene, load_scene
from wavefocus.rendering.scene.size import check_scene_size, size_words
from wavefocus.rig.limits import (
    DEFAULT_FULL_SCALE_V,
    DEFAULT_INTERFACE_RATE_HZ,
    interface_of,
    limited_words,
    rig_of,
    within,
)
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.drive_file import drive_in_blocks
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import require_outputs, write_whole
from wavefocus.storage.units import PLAYED_UNITS, quantity

if TYPE_CHECKING:
    from wavefocus.config.rig import RigConfig

Float64Array = NDArray[np.float64]


OUTLINE_POINTS = 400
MAX_WHOLE_BYTES = 2 * 2**30
"""Drives that take more are streamed without being asked: 22 minutes on 20 actuators at 10 kHz."""


@dataclass(frozen=True, slots=True)
class _Job:
    """A scene to be rendered, and the rig whose limits or full scale count, if any."""

    scene_file: Path
    scene: Scene
    bank: Bank
    rig: RigConfig | None
    interface: Interface | None
    options: RenderOptions

    @property
    def wav_scale(self) -> tuple[int, float, Float64Array]:
        """Rate and full scale of a WAV file, and the gain of each actuator, for outputs differ in full scale."""
        if self.rig is None:
            return DEFAULT_INTERFACE_RATE_HZ, DEFAULT_FULL_SCALE_V, np.ones(self.bank.actuators)
        full_scale_v = self.rig.player.full_scale_v
        return self.rig.player.interface_rate_hz, full_scale_v, full_scale_v / interface_of(self.rig).full_scale_v


@dataclass(frozen=True, slots=True)
class _Rendered:
    """Drives within their limits, to be written block by block.

    about: Start, method, bound and foci, as `drive_in_blocks` takes them.
    focus_peak, unsaturated: Predicted response, and relative rms without saturation; None where not computed.
    quiet: Levels at the quiet places, none where they were not computed.
    """

    shape: tuple[int, int]
    blocks: Iterator[Float64Array]
    about: dict[str, Any]
    facts: RenderReport
    focus_peak: float | None = None
    unsaturated: Float64Array | None = None
    quiet: tuple[QuietLevel, ...] = ()


def render(
    scene_file: Path,
    bank: Path,
    out: Path,
    *,
    wav: Path | None,
    picture: Path | None,
    rig_file: Path | None,
    options: RenderOptions,
    stream: bool = False,
    allow_large: bool = False,
    force: bool = False,
    as_json: bool,
) -> None:
    """Render a scene and write the drive file, a WAV file and a picture of the scene when asked."""
    require_outputs((out, wav, picture), input_files(scene_file, bank, rig_file), force=force)
    scene = load_scene(scene_file, allow_large=allow_large)
    with open_bank(bank) as view:
        working_on("verifying the rows of the bank")
        view.require_sound()
        working_on("")
        if wav is not None and view.drive_unit not in PLAYED_UNITS:
            raise InputError(
                f"--wav {wav}: {bank} takes drives in {view.drive_unit}, and a WAV file's full scale is in volts"
            )
        rig = None if (rig_file, wav, picture) == (None, None, None) else rig_of(rig_file, view)
        if rig_file is not None and rig is not None:
            scene = within(scene, rig)
        if stream and options.device != "cpu":
            raise InputError("--stream goes with --device cpu alone")
        limited = rig is not None and (wav is not None or rig_file is not None)
        job = _Job(scene_file, scene, view, rig, interface_of(rig) if rig is not None and limited else None, options)
        whole = options.device != "cpu"
        with naming(scene_file, view):
            streamed = not whole and (stream or _too_large(job))
            rendered = _in_two_passes(job) if streamed else _in_memory(job)
        peak_v = _write(job, rendered, out, wav, force=force)
        if picture is not None:
            _write_picture(job, rendered.facts, picture)
        figures = _report(job, rendered, out, peak_v, rig_file)
        if as_json:
            print(json.dumps(figures | ({"streamed": True} if streamed else {})))


def _in_memory(job: _Job) -> _Rendered:
    with progress("render", 1) as report:
        drive, facts = render_by_options(job.scene, job.bank, job.options, report, job.interface)
    unsaturated = None
    regularisation = job.scene.regularisation
    if regularisation.saturation or regularisation.saturation_absolute:
        output = job.scene.output.model_copy(update={"limit_v": None, "limit_rms_v": None})  # limits change no ratio
        if facts.interpolation_errors is not None:
            output = output.model_copy(update={"interpolation": facts.interpolation_errors.kind})  # chosen once
        plain = replace(
            job.scene,
            regularisation=regularisation.model_copy(update={"saturation": 0.0, "saturation_absolute": 0.0}),
            output=output,
        )
        with progress("render", 1) as report:
            unsaturated = render_by_options(plain, job.bank, job.options, report)[1].relative_rms_drive
    foci = drive.focus_sample, drive.focus_position, drive.focus_source
    about = {"start_s": drive.start_s, "method": drive.method, "omitted_bound": drive.omitted_bound, "foci": foci}
    about["quiet"], about["focus_mm"] = drive.quiet, drive.focus_mm
    actuators, samples = drive.drive_v.shape
    return _Rendered(
        (actuators, samples), iter([drive.drive_v]), about, facts, predicted_focus_peak(drive, job.bank), unsaturated,
        quiet_levels(drive, job.bank),
    )  # fmt: skip


def _in_two_passes(job: _Job) -> _Rendered:
    """Render in constant memory; the predicted response would need the drives once more."""
    options, rate_hz = job.options, float(job.bank.sample_rate_hz)
    renderer = SceneRenderer(
        job.scene, job.bank, interface=job.interface, method=options.method, tolerance_db=options.tolerance_db,
        interpolation_tolerance=options.interpolation_tolerance,
    )  # fmt: skip
    actuators, samples = renderer.shape
    size = size_words(8.0 * actuators * samples)
    say(f"{samples / rate_hz:.4g} s of drives, {size}, in two passes: the first finds the scale, the second writes")
    with progress("first pass", samples) as report:
        facts = renderer.prepare(report)
    sampled = renderer.sampled
    about = {
        "start_s": sampled.start_s, "method": sampled.method, "foci": sampled.foci,
        "omitted_bound": facts.omitted_bound, "quiet": facts.quiet_tracks, "focus_mm": sampled.focus_mm,
    }  # fmt: skip
    return _Rendered(renderer.shape, renderer.blocks(), about, facts, quiet=rendered_levels(facts.quiet_tracks))


def _write(job: _Job, rendered: _Rendered, out: Path, wav: Path | None, *, force: bool) -> float:
    """Write the drive file, and a WAV file where one is asked for; returns the largest magnitude."""
    samples, peak_v = rendered.shape[1], 0.0
    bank_hz, (rate_hz, full_scale_v, each) = float(job.bank.sample_rate_hz), job.wav_scale
    with (
        drive_in_blocks(
            out, rendered.shape, sample_rate_hz=bank_hz, drive_unit=job.bank.drive_unit, scale=rendered.facts.scale,
            force=force, **rendered.about,
        ) as append,
        progress("write", samples) as report,
    ):  # fmt: skip

        def written() -> Iterator[Float64Array]:
            nonlocal peak_v
            done = 0
            for block in rendered.blocks:
                append(block)
                peak_v = max(peak_v, float(peaks(block).max()))
                done += block.shape[1]
                yield block
                report(done, samples)

        if wav is None:
            deque(written(), maxlen=0)
        else:
            stream_wav(
                wav, (block * each[:, np.newaxis] for block in written()), rendered.shape, bank_hz,
                interface_rate_hz=rate_hz, full_scale_v=full_scale_v,
            )  # fmt: skip
            say(f"{wav}: {rate_hz} Hz, full scale {full_scale_v:g} V")
    return peak_v


def _report(job: _Job, rendered: _Rendered, out: Path, peak_v: float, rig_file: Path | None) -> dict[str, Any]:
    """Say what was rendered; returns the same figures for JSON."""
    facts, limiting, about, (actuators, samples) = (
        rendered.facts,
        rendered.facts.limiting,
        rendered.about,
        rendered.shape,
    )
    unit, relative = field_unit(job.bank), facts.relative_rms_drive
    range_db, unsaturated, foci = dynamic_range_db(relative), rendered.unsaturated, len(about["foci"][0])
    figures = {
        "drive": str(out),
        "method": about["method"],
        "samples": samples,
        "start_s": about["start_s"],
        "focus_points": foci,
        "peak_v": peak_v,
        "scale": facts.scale,
        "focus_peak": rendered.focus_peak,
        "response_unit": unit,
        "limited_by": limiting.decided_by,
        "limiting_actuator": limiting.actuator,
        "omitted_bound": about["omitted_bound"],
        "relative_rms": relative.round(6).tolist(),
        "relative_rms_unsaturated": None if unsaturated is None else unsaturated.round(6).tolist(),
        "dynamic_range_db": round(range_db, 3),
        "warnings": list(facts.warnings),
    }
    for warning in facts.warnings:
        say(f"warning: {warning}")
    say(
        f"{out}: {about['method']}, {actuators} actuators, {samples / job.bank.sample_rate_hz:.3f} s, "
        f"{foci} focus points, largest drive {quantity(f'{peak_v:.3g}', job.bank.drive_unit)}"
    )
    if rendered.focus_peak is not None:
        say(f"predicted response at the focus: up to {rendered.focus_peak:.3g} {unit}")
    if limiting.decided_by is not None:
        say(limited_words(limiting, rig_file))
    if job.options.tolerance_db is not None:
        what = f": {', '.join(facts.left_out_words)}" if facts.left_out_words else ""
        say(f"left out no more than {facts.omitted_bound:.3g} of the drives (relative L2, proved){what}")
    without = "" if unsaturated is None else f", {dynamic_range_db(unsaturated):.1f} dB without saturation"
    say(f"rms of the drives: actuators differ by up to {range_db:.1f} dB{without}")
    for level in rendered.quiet:
        say(f"quiet: {level}")
    if facts.interpolation_errors is not None:
        say(facts.interpolation_errors.words)
        figures["interpolation"] = facts.interpolation_errors.facts
    if facts.quiet is not None:
        say(f"quiet places cost {facts.quiet.energy:.3g} times the energy of plain time reversal")
        figures["quiet"] = levels_json(rendered.quiet, facts.quiet.plain_db, facts.quiet.multiplier)
        figures["quiet_energy"] = facts.quiet.energy
    return figures


def _write_picture(job: _Job, facts: RenderReport, path: Path) -> None:
    from wavefocus.rendering.report.scene_picture import scene_picture

    outline_mm = None if job.rig is None else job.rig.surface.outline.line(OUTLINE_POINTS)
    with naming(job.scene_file, job.bank):
        write_whole(path, scene_picture(job.scene, job.bank, outline_mm=outline_mm, sampled=facts.sources).png)
    say(f"{path}: the scene before and after snapping to the bank's positions")


def _too_large(job: _Job) -> bool:
    """Whether the drives are not to be held in memory whole; InputError: they are larger than allowed."""
    bank = job.bank
    size = check_scene_size(
        job.scene, sample_rate_hz=float(bank.sample_rate_hz), taps=bank.taps, actuators=bank.actuators
    )
    return size.drive_bytes > MAX_WHOLE_BYTES
