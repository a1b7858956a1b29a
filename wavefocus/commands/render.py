"""``wavefocus render``: a scene becomes drive signals."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from config.stadium import stadium_rim
from rendering.device import cuda_device
from rendering.drive.coil_limits import dynamic_range_db, relative_rms, strictest
from rendering.drive.rendering import render_with_report
from rendering.drive.streamed_drive import StreamedDrive
from rendering.drive.wav import stream_wav, write_wav
from rendering.field.prediction import predicted_focus_peak
from rendering.report.render_report import RenderReport
from rendering.scene.loading import load_scene
from rendering.scene.model import Regularisation, Scene
from rendering.scene.size import check_scene_size, size_words
from storage.bank.reading import Bank, open_bank
from storage.drive_file import Drive, DriveAbout, drive_in_blocks, write_drive
from storage.errors import InputError
from storage.output_files import require_outputs, write_whole
from storage.units import quantity
from wavefocus.console import progress, say
from wavefocus.input_files import input_files
from wavefocus.rig.limits import (
    DEFAULT_FULL_SCALE_V,
    DEFAULT_INTERFACE_RATE_HZ,
    PLAYED_UNITS,
    interface_of,
    limited_words,
    rig_of,
    within,
)

if TYPE_CHECKING:
    from config.rig import RigConfig
    from rendering.drive.inverse_filter import InverseReport

Focusing = Literal["time-reversal", "inverse"]


@dataclass(frozen=True, slots=True)
class RenderOptions:
    """How a scene is rendered, as asked for on the command line.

    Parameters
    ----------
    method : {"sampled", "exact"}, optional
        Eq. (16) or (9).
    tolerance_db : float, optional
        What may be left out, < 0.
    interpolation_tolerance : float, optional
        Largest relative error between the bank's positions, > 0.
    focusing : {"time-reversal", "inverse"}
        How waves are made to meet.
    regularisation_db : float, optional
        Of the inverse filter, < 0.
    device : {"cpu", "cuda"}
        Where the drives are accumulated; on a GPU all is computed.

    Raises
    ------
    InputError
        An option of the one way of focusing is given for the other, or one that a GPU does not know.
    """

    method: Literal["sampled", "exact"] | None = None
    tolerance_db: float | None = None
    interpolation_tolerance: float | None = None
    focusing: Focusing = "time-reversal"
    regularisation_db: float | None = None
    device: Literal["cpu", "cuda"] = "cpu"

    def __post_init__(self) -> None:
        if self.device != "cpu" and (self.focusing == "inverse" or self.tolerance_db is not None):
            raise InputError(f"--device {self.device} goes neither with --focusing inverse nor with --tolerance-db")
        if self.focusing == "inverse":
            given = {
                "--method": self.method,
                "--tolerance-db": self.tolerance_db,
                "--interpolation-tolerance": self.interpolation_tolerance,
            }
            if wrong := [key for key, value in given.items() if value is not None]:
                raise InputError(f"{wrong[0]} is for time reversal; leave it out with --focusing inverse")
        elif self.regularisation_db is not None:
            raise InputError("--regularisation-db is for the inverse filter; add --focusing inverse")


OUTLINE_POINTS = 400


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
        view.require_sound()
        if wav is not None and view.drive_unit not in PLAYED_UNITS:
            raise InputError(
                f"--wav {wav}: {bank} takes drives in {view.drive_unit}, and a WAV file's full scale is in volts"
            )
        rig = None if (rig_file, wav, picture) == (None, None, None) else rig_of(rig_file, view)
        if rig_file is not None and rig is not None:
            scene = within(scene, rig)
        if options.focusing == "inverse":
            if stream:
                raise InputError("--stream is for time reversal; leave it out with --focusing inverse")
        elif options.device != "cpu":
            if stream:
                raise InputError("--stream goes with --device cpu alone")
        elif stream or too_large(scene_file, scene, view):
            render_streamed(scene_file, scene, view, out, wav, rig, rig_file, options, as_json=as_json)
            if picture is not None:
                write_picture(picture, scene_file, scene, view, rig)
            return
        drive, facts = rendered(scene_file, scene, view, options)
        if rig is not None and (wav is not None or rig_file is not None):
            drive, facts = _within_full_scale(drive, facts, rig)
        unsaturated = None
        if options.focusing == "time-reversal" and _saturates(scene):
            unsaturated = _unsaturated_rms(scene_file, scene, view, options)
        if wav is not None:
            _write_wav(wav, drive, rig)
        if picture is not None:
            write_picture(picture, scene_file, scene, view, rig)
        focus_peak, unit = predicted_focus_peak(drive, view), view.response_unit.removesuffix("/V")
    write_drive(out, drive)
    for warning in facts.warnings:
        say(f"warning: {warning}")
    samples = drive.drive_v.shape[1]
    peak_v = float(max(drive.drive_v.max(initial=0.0), -drive.drive_v.min(initial=0.0)))
    say(
        f"{out}: {drive.method}, {drive.drive_v.shape[0]} actuators, {samples / drive.sample_rate_hz:.3f} s, "
        f"{len(drive.focus_sample)} focus points, largest drive {quantity(f'{peak_v:.3g}', drive.drive_unit)}"
    )
    if focus_peak is not None:
        say(f"predicted response at the focus: up to {focus_peak:.3g} {unit}")
    if facts.limiting.decided_by is not None:
        say(limited_words(facts.limiting, rig_file))
    if options.tolerance_db is not None:
        words = list(facts.left_out_words) if isinstance(facts, RenderReport) else []
        what = f": {', '.join(words)}" if words else ""
        say(f"left out no more than {drive.omitted_bound:.3g} of the drives (relative L2, proved){what}")
    relative = relative_rms(drive.drive_v)
    range_db = dynamic_range_db(relative)
    without = "" if unsaturated is None else f", {dynamic_range_db(unsaturated):.1f} dB without saturation"
    say(f"rms of the drives: actuators differ by up to {range_db:.1f} dB{without}")
    if not isinstance(facts, RenderReport):
        frequency_hz, condition = facts.worst_condition
        say(
            f"{facts.control_points} control points, condition at most {condition:.3g} (at {frequency_hz:.3g} Hz), held"
            f" to {facts.regularised_condition.max():.3g} by {facts.regularisation_db:g} dB; control points are"
            f" {100 * facts.misfit:.3g} % off"
        )
    if as_json:
        figures = {
            "drive": str(out),
            "method": drive.method,
            "samples": samples,
            "start_s": drive.start_s,
            "focus_points": len(drive.focus_sample),
            "peak_v": peak_v,
            "scale": drive.scale,
            "focus_peak": focus_peak,
            "response_unit": unit,
            "limited_by": facts.limiting.decided_by,
            "limiting_actuator": facts.limiting.actuator,
            "omitted_bound": drive.omitted_bound,
            "relative_rms": relative.round(6).tolist(),
            "relative_rms_unsaturated": None if unsaturated is None else unsaturated.round(6).tolist(),
            "dynamic_range_db": round(range_db, 3),
            "warnings": list(facts.warnings),
        }
        if not isinstance(facts, RenderReport):
            figures |= _inverse_figures(facts)
        print(json.dumps(figures))


def rendered(
    scene_file: Path, scene: Scene, bank: Bank, options: RenderOptions | None = None
) -> tuple[Drive, RenderReport | InverseReport]:
    """Render a scene with progress; what is wrong with it is told with the file's name.

    Raises InputError: the scene does not fit the bank.
    """
    wanted = options or RenderOptions()
    with progress("render", 1) as report:
        try:
            if wanted.focusing == "inverse":
                from rendering.drive.inverse_filter import REGULARISATION_DB, inverse_filter

                regularisation_db = REGULARISATION_DB if wanted.regularisation_db is None else wanted.regularisation_db
                return inverse_filter(scene, bank, regularisation_db=regularisation_db)
            return render_with_report(
                scene,
                bank,
                method=wanted.method,
                tolerance_db=wanted.tolerance_db,
                interpolation_tolerance=wanted.interpolation_tolerance,
                on_progress=report,
                device=None if wanted.device == "cpu" else cuda_device(),
            )
        except InputError as wrong:
            named = str(wrong) if str(bank.path) in str(wrong) else f"{scene_file}: {wrong}"
            raise InputError(named) from None


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


def _saturates(scene: Scene) -> bool:
    return bool(scene.regularisation.saturation or scene.regularisation.saturation_absolute)


def _unsaturated_rms(
    scene_file: Path, scene: Scene, bank: Bank, options: RenderOptions
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Relative rms of each actuator's drive if the scene did not saturate; limits change no ratio."""
    plain = replace(
        scene,
        regularisation=Regularisation(normalise=scene.regularisation.normalise),
        output=replace(scene.output, limit_v=None, limit_rms_v=None),
    )
    drive, _ = rendered(scene_file, plain, bank, options)
    return relative_rms(drive.drive_v)


def _inverse_figures(facts: InverseReport) -> dict[str, object]:
    frequency_hz, condition = facts.worst_condition
    return {
        "control_points": facts.control_points,
        "regularisation_db": facts.regularisation_db,
        "condition": condition if np.isfinite(condition) else None,
        "condition_at_hz": frequency_hz,
        "regularised_condition": float(facts.regularised_condition.max()),
        "misfit": facts.misfit,
        "cut_share": facts.cut_share,
    }


def _write_wav(path: Path, drive: Drive, rig: RigConfig | None) -> None:
    """Write the drives at the interface's rate, full scale being what the rig's player is calibrated to."""
    rate_hz, full_scale_v, drive_v = DEFAULT_INTERFACE_RATE_HZ, DEFAULT_FULL_SCALE_V, drive.drive_v
    if rig is not None:
        rate_hz, full_scale_v = rig.player.interface_rate_hz, rig.player.full_scale_v
        # A file has one full scale; an output that has another gets so much more or less of it.
        drive_v = drive_v * (full_scale_v / interface_of(rig).full_scale_v)[:, np.newaxis]
    write_wav(path, drive_v, drive.sample_rate_hz, interface_rate_hz=rate_hz, full_scale_v=full_scale_v)
    say(f"{path}: {rate_hz} Hz, full scale {full_scale_v:g} V")


def write_picture(path: Path, scene_file: Path, scene: Scene, bank: Bank, rig: RigConfig | None) -> None:
    """Draw the scene before and after snapping."""
    from rendering.report.scene_picture import scene_picture

    outline_mm = None
    if rig is not None:
        outline_mm = stadium_rim(rig.surface.length_mm, rig.surface.width_mm, 0.0, OUTLINE_POINTS)
    try:
        png = scene_picture(scene, bank, outline_mm=outline_mm).png
    except InputError as wrong:
        raise InputError(f"{scene_file}: {wrong}") from None
    write_whole(path, png)
    say(f"{path}: the scene before and after snapping to the bank's positions")


Float64Array = NDArray[np.float64]

MOST_WHOLE_BYTES = 2 * 2**30
"""Drives that take more are streamed without being asked: 22 minutes on 20 actuators at 10 kHz."""


def too_large(scene_file: Path, scene: Scene, bank: Bank) -> bool:
    """Whether the drives of a scene had better not be held in memory whole.

    Raises InputError: the scene is larger than it is allowed to be.
    """
    rate_hz = float(bank.sample_rate_hz)
    try:
        size = check_scene_size(scene, sample_rate_hz=rate_hz, taps=bank.taps, actuators=bank.actuators)
    except InputError as wrong:
        raise InputError(f"{scene_file}: {wrong}") from None
    return size.drive_bytes > MOST_WHOLE_BYTES


def render_streamed(
    scene_file: Path,
    scene: Scene,
    bank: Bank,
    out: Path,
    wav: Path | None,
    rig: RigConfig | None,
    rig_file: Path | None,
    options: RenderOptions,
    *,
    as_json: bool,
) -> None:
    """Render a scene in two passes and write the drive file, and a WAV file when asked, in constant memory.

    Raises InputError: the scene does not fit the bank, or a drive is beyond the interface's full scale.
    """
    rate_hz, full_scale_v, each = DEFAULT_INTERFACE_RATE_HZ, DEFAULT_FULL_SCALE_V, np.ones(bank.actuators)
    fits = rig is not None and (wav is not None or rig_file is not None)
    if rig is not None:
        rate_hz, full_scale_v = rig.player.interface_rate_hz, rig.player.full_scale_v
        # A file has one full scale; an output that has another gets so much more or less of it.
        each = full_scale_v / interface_of(rig).full_scale_v
    try:
        streamed = StreamedDrive(
            scene,
            bank,
            interface=interface_of(rig) if rig is not None and fits else None,
            method=options.method,
            tolerance_db=options.tolerance_db,
            interpolation_tolerance=options.interpolation_tolerance,
        )
        actuators, samples = streamed.shape
        seconds = samples / bank.sample_rate_hz
        size = size_words(8.0 * actuators * samples)
        say(f"{seconds:.4g} s of drives, {size}, in two passes: the first finds the scale, the second writes")
        with progress("first pass", samples) as report:
            facts = streamed.prepare(report)
        about = DriveAbout(
            float(bank.sample_rate_hz),
            streamed.live.start_s,
            streamed.live.method,
            facts.scale,
            facts.omitted_bound,
            *streamed.foci,
            drive_unit=bank.drive_unit,
        )
        with ExitStack() as stack:
            append = stack.enter_context(drive_in_blocks(out, about, (actuators, samples)))
            report = stack.enter_context(progress("second pass", samples))
            blocks = _kept(streamed.blocks(), append, report, samples)
            if wav is None:
                for _ in blocks:
                    pass
            else:
                stream_wav(
                    wav,
                    (block * each[:, np.newaxis] for block in blocks),
                    (actuators, samples),
                    float(bank.sample_rate_hz),
                    interface_rate_hz=rate_hz,
                    full_scale_v=full_scale_v,
                )
                say(f"{wav}: {rate_hz} Hz, full scale {full_scale_v:g} V")
    except InputError as wrong:
        named = str(wrong) if str(bank.path) in str(wrong) else f"{scene_file}: {wrong}"
        raise InputError(named) from None
    for warning in facts.warnings:
        say(f"warning: {warning}")
    foci = len(streamed.foci[0])
    say(
        f"{out}: {streamed.live.method}, {actuators} actuators, {seconds:.3f} s, {foci} focus points,"
        f" largest drive {quantity(f'{streamed.peak_v:.3g}', bank.drive_unit)}"
    )
    if facts.limiting.decided_by is not None:
        say(limited_words(facts.limiting, rig_file))
    if options.tolerance_db is not None:
        what = f": {', '.join(facts.left_out_words)}" if facts.left_out_words else ""
        say(f"left out no more than {facts.omitted_bound:.3g} of the drives (relative L2, proved){what}")
    say(f"rms of the drives: actuators differ by up to {facts.dynamic_range_db:.1f} dB")
    if as_json:
        figures = {
            "drive": str(out),
            "method": streamed.live.method,
            "samples": samples,
            "start_s": streamed.live.start_s,
            "focus_points": foci,
            "peak_v": streamed.peak_v,
            "scale": facts.scale,
            "focus_peak": None,  # needs the drives once more
            "response_unit": bank.response_unit.removesuffix("/V"),
            "limited_by": facts.limiting.decided_by,
            "limiting_actuator": facts.limiting.actuator,
            "omitted_bound": facts.omitted_bound,
            "relative_rms": facts.relative_rms_drive.round(6).tolist(),
            "relative_rms_unsaturated": None,
            "dynamic_range_db": round(facts.dynamic_range_db, 3),
            "warnings": list(facts.warnings),
            "streamed": True,
        }
        print(json.dumps(figures))


def _kept(
    blocks: Iterable[Float64Array],
    append: Callable[[Float64Array], None],
    report: Callable[[int, int], None],
    samples: int,
) -> Iterator[Float64Array]:
    """The same blocks, written on their way."""
    done = 0
    for block in blocks:
        append(block)
        done += block.shape[1]
        yield block
        report(done, samples)
