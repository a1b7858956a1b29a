"""``wavefocus render``: a scene becomes drive signals."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wavefocus.config.scene import Output, Regularisation
from wavefocus.console import Report, progress, say, working_on
from wavefocus.drives import RenderOptions, naming, render_by_options
from wavefocus.input_files import input_files
from wavefocus.rendering.drive.coil_limits import dynamic_range_db, relative_rms, strictest
from wavefocus.rendering.drive.streamed import StreamedDrive
from wavefocus.rendering.drive.wav import in_chunks, stream_wav
from wavefocus.rendering.field.prediction import field_unit, predicted_focus_peak
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
from wavefocus.storage.drive_file import Drive, drive_in_blocks, write_drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import require_outputs, write_whole
from wavefocus.storage.units import PLAYED_UNITS, quantity

if TYPE_CHECKING:
    from wavefocus.config.rig import RigConfig
    from wavefocus.rendering.drive.inverse_filter import InverseReport

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
    out: Path
    wav: Path | None
    rig: RigConfig | None
    limited: bool
    options: RenderOptions
    force: bool

    @property
    def wav_scale(self) -> tuple[int, float, Float64Array]:
        """Rate and full scale of a WAV file, and the gain of each actuator, for outputs differ in full scale."""
        if self.rig is None:
            return DEFAULT_INTERFACE_RATE_HZ, DEFAULT_FULL_SCALE_V, np.ones(self.bank.actuators)
        full_scale_v = self.rig.player.full_scale_v
        return self.rig.player.interface_rate_hz, full_scale_v, full_scale_v / interface_of(self.rig).full_scale_v


@dataclass(frozen=True, slots=True)
class _Result:
    """Figures of a render; `focus_peak` and `unsaturated` (relative rms without saturation) None where not computed."""

    method: str
    shape: tuple[int, int]
    start_s: float
    foci: int
    peak_v: float
    scale: float
    omitted_bound: float
    relative_rms: Float64Array
    facts: RenderReport | InverseReport
    focus_peak: float | None = None
    unsaturated: Float64Array | None = None


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
        if stream and options.focusing == "inverse":
            raise InputError("--stream is for time reversal; leave it out with --focusing inverse")
        if stream and options.device != "cpu":
            raise InputError("--stream goes with --device cpu alone")
        limited = rig is not None and (wav is not None or rig_file is not None)
        job = _Job(scene_file, scene, view, out, wav, rig, limited, options, force)
        whole = options.focusing == "inverse" or options.device != "cpu"
        streamed = not whole and (stream or _too_large(job))
        result = _render_streamed(job) if streamed else _render_whole(job)
        if picture is not None:
            _write_picture(job, picture)
        _report(job, result, rig_file, streamed=streamed, as_json=as_json)


def _render_whole(job: _Job) -> _Result:
    options = job.options
    drive, facts = rendered(job.scene_file, job.scene, job.bank, options)
    if job.rig is not None and job.limited:
        drive, facts = _within_full_scale(drive, facts, job.rig)
    unsaturated = None
    regularisation = job.scene.regularisation
    if options.focusing == "time-reversal" and (regularisation.saturation or regularisation.saturation_absolute):
        plain = replace(  # limits change no ratio
            job.scene,
            regularisation=Regularisation(normalise=regularisation.normalise),
            output=Output(interpolation=job.scene.output.interpolation),
        )
        unsaturated = relative_rms(rendered(job.scene_file, plain, job.bank, options)[0].drive_v)
    if job.wav is not None:
        rate_hz, full_scale_v, each = job.wav_scale
        volts = drive.drive_v * each[:, np.newaxis]
        stream_wav(
            job.wav, in_chunks(volts), (len(volts), volts.shape[1]), drive.sample_rate_hz,
            interface_rate_hz=rate_hz, full_scale_v=full_scale_v,
        )  # fmt: skip
    focus_peak = predicted_focus_peak(drive, job.bank)
    write_drive(job.out, drive, force=job.force)
    actuators, samples = drive.drive_v.shape
    return _Result(
        method=drive.method,
        shape=(actuators, samples),
        start_s=drive.start_s,
        foci=len(drive.focus_sample),
        peak_v=float(max(drive.drive_v.max(initial=0.0), -drive.drive_v.min(initial=0.0))),
        scale=drive.scale,
        omitted_bound=drive.omitted_bound,
        relative_rms=relative_rms(drive.drive_v),
        facts=facts,
        focus_peak=focus_peak,
        unsaturated=unsaturated,
    )


def _render_streamed(job: _Job) -> _Result:
    """Render in two passes, in constant memory; the predicted response would need the drives once more."""
    bank, options = job.bank, job.options
    rate_hz = float(bank.sample_rate_hz)
    with naming(job.scene_file, bank):
        streamed = StreamedDrive(
            job.scene, bank, interface=interface_of(job.rig) if job.rig is not None and job.limited else None,
            method=options.method, tolerance_db=options.tolerance_db,
            interpolation_tolerance=options.interpolation_tolerance,
        )  # fmt: skip
        actuators, samples = streamed.shape
        size = size_words(8.0 * actuators * samples)
        seconds = samples / rate_hz
        say(f"{seconds:.4g} s of drives, {size}, in two passes: the first finds the scale, the second writes")
        with progress("first pass", samples) as report:
            facts = streamed.prepare(report)
        sampled = streamed.live.sampled
        with (
            drive_in_blocks(
                job.out,
                streamed.shape,
                sample_rate_hz=rate_hz,
                start_s=sampled.start_s,
                method=sampled.method,
                scale=facts.scale,
                omitted_bound=facts.omitted_bound,
                foci=sampled.foci,
                drive_unit=bank.drive_unit,
                force=job.force,
            ) as append,
            progress("second pass", samples) as report,
        ):
            interface_hz, full_scale_v, each = job.wav_scale
            blocks = _written(streamed.blocks(), append, report, samples)
            if job.wav is None:
                deque(blocks, maxlen=0)
            else:
                stream_wav(
                    job.wav, (block * each[:, np.newaxis] for block in blocks), streamed.shape, rate_hz,
                    interface_rate_hz=interface_hz, full_scale_v=full_scale_v,
                )  # fmt: skip
    return _Result(
        method=sampled.method,
        shape=streamed.shape,
        start_s=sampled.start_s,
        foci=len(sampled.foci[0]),
        peak_v=streamed.peak_v,
        scale=facts.scale,
        omitted_bound=facts.omitted_bound,
        relative_rms=facts.relative_rms_drive,
        facts=facts,
    )


def _written(
    blocks: Iterable[Float64Array], append: Callable[[Float64Array], None], report: Report, samples: int
) -> Iterator[Float64Array]:
    """The same blocks, written on their way."""
    done = 0
    for block in blocks:
        append(block)
        done += block.shape[1]
        yield block
        report(done, samples)


def _report(job: _Job, result: _Result, rig_file: Path | None, *, streamed: bool, as_json: bool) -> None:
    facts, limiting, (actuators, samples) = result.facts, result.facts.limiting, result.shape
    unit = field_unit(job.bank)
    range_db = dynamic_range_db(result.relative_rms)
    if job.wav is not None:
        rate_hz, full_scale_v, _ = job.wav_scale
        say(f"{job.wav}: {rate_hz} Hz, full scale {full_scale_v:g} V")
    for warning in facts.warnings:
        say(f"warning: {warning}")
    say(
        f"{job.out}: {result.method}, {actuators} actuators, {samples / job.bank.sample_rate_hz:.3f} s, "
        f"{result.foci} focus points, largest drive {quantity(f'{result.peak_v:.3g}', job.bank.drive_unit)}"
    )
    if result.focus_peak is not None:
        say(f"predicted response at the focus: up to {result.focus_peak:.3g} {unit}")
    if limiting.decided_by is not None:
        say(limited_words(limiting, rig_file))
    if job.options.tolerance_db is not None and isinstance(facts, RenderReport):
        what = f": {', '.join(facts.left_out_words)}" if facts.left_out_words else ""
        say(f"left out no more than {result.omitted_bound:.3g} of the drives (relative L2, proved){what}")
    unsaturated = result.unsaturated
    without = "" if unsaturated is None else f", {dynamic_range_db(unsaturated):.1f} dB without saturation"
    say(f"rms of the drives: actuators differ by up to {range_db:.1f} dB{without}")
    if not isinstance(facts, RenderReport):
        frequency_hz, condition = facts.worst_condition
        say(
            f"{facts.control_points} control points, condition at most {condition:.3g} (at {frequency_hz:.3g} Hz), held"
            f" to {facts.regularised_condition.max():.3g} by {facts.regularisation_db:g} dB; control points are"
            f" {100 * facts.misfit:.3g} % off"
        )
    if not as_json:
        return
    figures = {
        "drive": str(job.out),
        "method": result.method,
        "samples": samples,
        "start_s": result.start_s,
        "focus_points": result.foci,
        "peak_v": result.peak_v,
        "scale": result.scale,
        "focus_peak": result.focus_peak,
        "response_unit": unit,
        "limited_by": limiting.decided_by,
        "limiting_actuator": limiting.actuator,
        "omitted_bound": result.omitted_bound,
        "relative_rms": result.relative_rms.round(6).tolist(),
        "relative_rms_unsaturated": None if unsaturated is None else unsaturated.round(6).tolist(),
        "dynamic_range_db": round(range_db, 3),
        "warnings": list(facts.warnings),
    }
    if streamed:
        figures["streamed"] = True
    if not isinstance(facts, RenderReport):
        figures |= {
            "control_points": facts.control_points,
            "regularisation_db": facts.regularisation_db,
            "condition": condition if np.isfinite(condition) else None,
            "condition_at_hz": frequency_hz,
            "regularised_condition": float(facts.regularised_condition.max()),
            "misfit": facts.misfit,
            "cut_share": facts.cut_share,
        }
    print(json.dumps(figures))


def rendered(
    scene_file: Path, scene: Scene, bank: Bank, options: RenderOptions | None = None
) -> tuple[Drive, RenderReport | InverseReport]:
    """Render a scene with progress.

    Raises InputError: the scene does not fit the bank.
    """
    with progress("render", 1) as report, naming(scene_file, bank):
        return render_by_options(scene, bank, options or RenderOptions(), report)


def _within_full_scale(
    drive: Drive, facts: RenderReport | InverseReport, rig: RigConfig
) -> tuple[Drive, RenderReport | InverseReport]:
    """Scale a drive that is within full scale at its samples and beyond it between them."""
    interface = interface_of(rig)
    if (np.abs(drive.drive_v).max(axis=1) > interface.full_scale_v).any():
        return drive, facts
    further = strictest([interface.between_samples(drive.drive_v, drive.sample_rate_hz)])
    if further.decided_by is None:
        return drive, facts
    before = facts.limiting.scale
    limiting = replace(further, scale=before * further.scale, reached_v=further.reached_v / before)
    scaled = replace(drive, drive_v=drive.drive_v * further.scale, scale=drive.scale * further.scale)
    return scaled, replace(facts, limiting=limiting)


def _write_picture(job: _Job, path: Path) -> None:
    from wavefocus.rendering.report.scene_picture import scene_picture

    outline_mm = None
    if job.rig is not None:
        outline_mm = job.rig.surface.outline.line(OUTLINE_POINTS)
    with naming(job.scene_file, job.bank):
        write_whole(path, scene_picture(job.scene, job.bank, outline_mm=outline_mm).png)
    say(f"{path}: the scene before and after snapping to the bank's positions")


def _too_large(job: _Job) -> bool:
    """Whether the drives are not to be held in memory whole; InputError: they are larger than allowed."""
    bank = job.bank
    with naming(job.scene_file, bank):
        size = check_scene_size(
            job.scene, sample_rate_hz=float(bank.sample_rate_hz), taps=bank.taps, actuators=bank.actuators
        )
    return size.drive_bytes > MAX_WHOLE_BYTES
