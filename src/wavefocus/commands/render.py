"""``wavefocus render``: a scene becomes drive signals."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.console import progress, say, spinner
from wavefocus.drives import naming
from wavefocus.input_files import input_files
from wavefocus.options import RenderOptions
from wavefocus.rendering.device import cuda_device
from wavefocus.rendering.drive.coil_limits import dynamic_range_db
from wavefocus.rendering.drive.rendering import MAX_WHOLE_BYTES, SceneRenderer
from wavefocus.rendering.drive.wav import Interface, stream_wav
from wavefocus.rendering.field.foci import predicted_focus_peak
from wavefocus.rendering.field.prediction import field_unit
from wavefocus.rendering.field.quiet_levels import QuietLevel, levels_json, quiet_levels, rendered_levels
from wavefocus.rendering.report.render_report import RenderReport
from wavefocus.rendering.scene.model import Scene, load_scene
from wavefocus.rig.limits import (
    DEFAULT_FULL_SCALE_V,
    DEFAULT_INTERFACE_RATE_HZ,
    interface_of,
    limited_words,
    rig_of,
    within,
)
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.drive_file import drive_pieces, read_drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import require_outputs, write_whole
from wavefocus.storage.units import PLAYED_UNITS, quantity

if TYPE_CHECKING:
    from wavefocus.config.rig import RigConfig

Float64Array = NDArray[np.float64]


OUTLINE_POINTS = 400


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


def render(
    scene_file: Path,
    bank: Path,
    out: Path,
    *,
    wav: Path | None,
    picture: Path | None,
    rig_file: Path | None,
    options: RenderOptions,
    allow_large: bool = False,
    force: bool = False,
    as_json: bool,
) -> None:
    """Render a scene and write the drive file, a WAV file and a picture of the scene when asked."""
    require_outputs((out, wav, picture), input_files(scene_file, bank, rig_file), force=force)
    scene = load_scene(scene_file, allow_large=allow_large)
    with open_bank(bank) as view:
        with spinner("verifying the rows of the bank"):
            view.require_sound()
        if wav is not None and view.drive_unit not in PLAYED_UNITS:
            raise InputError(
                f"--wav {wav}: {bank} takes drives in {view.drive_unit}, and a WAV file's full scale is in volts"
            )
        rig = None if (rig_file, wav, picture) == (None, None, None) else rig_of(rig_file, view)
        if rig_file is not None and rig is not None:
            scene = within(scene, rig)
        limited = rig is not None and (wav is not None or rig_file is not None)
        job = _Job(scene_file, scene, view, rig, interface_of(rig) if rig is not None and limited else None, options)
        with naming(scene_file, view):
            renderer, facts = _rendered(job, out, force=force)
            focus_peak, quiet = None, rendered_levels(facts.quiet_tracks)
            if 8 * renderer.shape[0] * renderer.shape[1] <= MAX_WHOLE_BYTES:  # a long drive is not predicted
                focus_peak, quiet = _predicted(job, out)
            unsaturated = _unsaturated(job, facts)
        if wav is not None:
            _write_wav(job, renderer.shape, out, wav)
        if picture is not None:
            _write_picture(job, facts, picture)
        figures = _report(job, renderer, facts, out, rig_file, focus_peak, unsaturated, quiet)
        if as_json:
            print(json.dumps(figures))


def _rendered(job: _Job, out: Path, *, force: bool) -> tuple[SceneRenderer, RenderReport]:
    """Write the drive file."""
    with spinner("preparing the scene: its interpolation and quiet places"):
        renderer = _renderer(job, job.scene, job.interface)
    with progress("render", renderer.shape[1]) as report:
        return renderer, renderer.write(out, report, force=force)


def _predicted(job: _Job, out: Path) -> tuple[float | None, tuple[QuietLevel, ...]]:
    """The response at the foci, and the levels at the quiet places."""
    with spinner("predicting the response at the foci"):
        drive = read_drive(out)
        return predicted_focus_peak(drive, job.bank), quiet_levels(drive, job.bank)


def _renderer(job: _Job, scene: Scene, interface: Interface | None) -> SceneRenderer:
    options = job.options
    return SceneRenderer(
        scene, job.bank, interface=interface, method=options.method, tolerance_db=options.tolerance_db,
        interpolation_tolerance=options.interpolation_tolerance,
        device=None if options.device == "cpu" else cuda_device(),
    )  # fmt: skip


def _unsaturated(job: _Job, facts: RenderReport) -> Float64Array | None:
    """Relative rms of the drives without saturation; None where the scene has none."""
    regularisation = job.scene.regularisation
    if not (regularisation.saturation or regularisation.saturation_absolute):
        return None
    output = job.scene.output.model_copy(update={"limit_v": None, "limit_rms_v": None})  # limits change no ratio
    if facts.interpolation_errors is not None:
        output = output.model_copy(update={"interpolation": facts.interpolation_errors.kind})  # chosen once
    plain = regularisation.model_copy(update={"saturation": 0.0, "saturation_absolute": 0.0})
    with progress("render without saturation", 1) as report:
        scene = replace(job.scene, regularisation=plain, output=output)
        return _renderer(job, scene, None).prepare(report).relative_rms_drive


def _write_wav(job: _Job, shape: tuple[int, int], drive_file: Path, wav: Path) -> None:
    """Write the WAV file of a drive file."""
    bank_hz, (rate_hz, full_scale_v, each) = float(job.bank.sample_rate_hz), job.wav_scale
    with drive_pieces(drive_file) as pieces, progress("write WAV", shape[1]) as report:

        def shown() -> Iterator[Float64Array]:
            done = 0
            for piece in pieces:
                yield piece * each[:, np.newaxis]
                done += piece.shape[1]
                report(done, shape[1])

        stream_wav(wav, shown(), shape, bank_hz, interface_rate_hz=rate_hz, full_scale_v=full_scale_v)
    say(f"{wav}: {rate_hz} Hz, full scale {full_scale_v:g} V")


def _report(
    job: _Job,
    renderer: SceneRenderer,
    facts: RenderReport,
    out: Path,
    rig_file: Path | None,
    focus_peak: float | None,
    unsaturated: Float64Array | None,
    quiet: tuple[QuietLevel, ...],
) -> dict[str, Any]:
    """Say what was rendered; returns the same figures for JSON.

    focus_peak, unsaturated: Predicted response, and relative rms without saturation; None where not computed.
    """
    limiting, (actuators, samples), sampled = facts.limiting, renderer.shape, renderer.sampled
    method, foci, peak_v = sampled.method, len(sampled.foci[0]), renderer.peak_v
    unit, relative, range_db = field_unit(job.bank), facts.relative_rms_drive, facts.dynamic_range_db
    figures = {
        "drive": str(out),
        "method": method,
        "samples": samples,
        "start_s": sampled.start_s,
        "focus_points": foci,
        "peak_v": peak_v,
        "scale": facts.scale,
        "focus_peak": focus_peak,
        "response_unit": unit,
        "limited_by": limiting.decided_by,
        "limiting_actuator": limiting.actuator,
        "omitted_bound": facts.omitted_bound,
        "relative_rms": relative.round(6).tolist(),
        "relative_rms_unsaturated": None if unsaturated is None else unsaturated.round(6).tolist(),
        "dynamic_range_db": round(range_db, 3),
        "warnings": list(facts.warnings),
    }
    for warning in facts.warnings:
        say(f"warning: {warning}")
    say(
        f"{out}: {method}, {actuators} actuators, {samples / job.bank.sample_rate_hz:.3f} s, "
        f"{foci} focus points, largest drive {quantity(f'{peak_v:.3g}', job.bank.drive_unit)}"
    )
    if focus_peak is not None:
        say(f"predicted response at the focus: up to {focus_peak:.3g} {unit}")
    if limiting.decided_by is not None:
        say(limited_words(limiting, rig_file))
    if job.options.tolerance_db is not None:
        what = ": double precision" if facts.single else ""
        say(f"left out no more than {facts.omitted_bound:.3g} of the drives (relative L2, proved){what}")
    without = "" if unsaturated is None else f", {dynamic_range_db(unsaturated):.1f} dB without saturation"
    say(f"rms of the drives: actuators differ by up to {range_db:.1f} dB{without}")
    for level in quiet:
        say(f"quiet: {level}")
    if facts.interpolation_errors is not None:
        say(facts.interpolation_errors.words)
        figures["interpolation"] = facts.interpolation_errors.facts
    if facts.quiet is not None:
        say(f"quiet places cost {facts.quiet.energy:.3g} times the energy of plain time reversal")
        figures["quiet"] = levels_json(quiet, facts.quiet.plain_db, facts.quiet.multiplier)
        figures["quiet_energy"] = facts.quiet.energy
    return figures


def _write_picture(job: _Job, facts: RenderReport, path: Path) -> None:
    from wavefocus.rendering.report.scene_picture import scene_picture

    outline_mm = None if job.rig is None else job.rig.surface.outline.line(OUTLINE_POINTS)
    with naming(job.scene_file, job.bank):
        write_whole(path, scene_picture(job.scene, job.bank, outline_mm=outline_mm, sampled=facts.sources).png)
    say(f"{path}: the scene before and after snapping to the bank's positions")
