"""``wavefocus render``: a scene becomes drive signals."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wavefocus.console import progress, say, spinner
from wavefocus.drives import naming
from wavefocus.input_files import input_files, require_sound
from wavefocus.options import RenderOptions
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.device import cuda_device
from wavefocus.rendering.drive.rendering import MAX_WHOLE_BYTES, SceneRenderer
from wavefocus.rendering.drive.wav import stream_wav
from wavefocus.rendering.field.foci import predicted_focus_peak
from wavefocus.rendering.field.prediction import field_unit
from wavefocus.rendering.field.quiet_levels import quiet_levels, rendered_levels
from wavefocus.rendering.scene.model import load_scene
from wavefocus.rig.limits import interface_of, limited_words, rig_of, within
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.drive_file import drive_pieces, read_drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import require_outputs
from wavefocus.storage.units import PLAYED_UNITS, quantity

if TYPE_CHECKING:
    from wavefocus.config.rig import RigConfig


def render(
    scene_file: Path,
    bank: Path,
    out: Path,
    *,
    wav: Path | None,
    rig_file: Path | None,
    options: RenderOptions,
    force: bool = False,
    as_json: bool,
) -> None:
    """Render a scene and write the drive file, and a WAV file when asked."""
    require_outputs((out, wav), input_files(scene_file, bank, rig_file), force=force)
    scene = load_scene(scene_file)
    with open_bank(bank) as view:
        require_sound(view)
        if wav is not None and view.drive_unit not in PLAYED_UNITS:
            raise InputError(
                f"--wav {wav}: {bank} takes drives in {view.drive_unit}, and a WAV file's full scale is in volts"
            )
        rig = None if (rig_file, wav) == (None, None) else rig_of(rig_file, view)
        if rig_file is not None and rig is not None:
            scene = within(scene, rig)
        with naming(scene_file, view):
            with spinner("preparing the scene: its interpolation and quiet places"):
                renderer = SceneRenderer(
                    scene, view, interface=None if rig is None else interface_of(rig), method=options.method,
                    tolerance_db=options.tolerance_db, device=None if options.device == "cpu" else cuda_device(),
                )  # fmt: skip
            with progress("render", renderer.shape[1]) as report:
                facts = renderer.write(out, report, force=force)
            focus_peak, quiet = None, rendered_levels(facts.quiet_tracks)
            if 8 * renderer.shape[0] * renderer.shape[1] <= MAX_WHOLE_BYTES:  # a long drive is not predicted
                with spinner("predicting the response at the foci"):
                    drive = read_drive(out)
                    focus_peak, quiet = predicted_focus_peak(drive, view), quiet_levels(drive, view)
        if wav is not None:
            _write_wav(view, rig, renderer.shape, out, wav)
        sampled, limiting, unit = renderer.sampled, facts.limiting, field_unit(view)
        focus_points = len(sampled.foci[0])
        figures: dict[str, Any] = {
            "drive": str(out), "method": sampled.method, "samples": renderer.shape[1], "start_s": sampled.start_s,
            "focus_points": focus_points, "peak_v": renderer.peak_v, "scale": facts.scale,
            "limited_by": limiting.decided_by, "limiting_actuator": limiting.actuator,
            "omitted_bound": facts.omitted_bound, "relative_rms": facts.relative_rms_drive.round(6).tolist(),
            "dynamic_range_db": round(facts.dynamic_range_db, 3), "warnings": list(facts.warnings),
            "focus_peak": focus_peak, "response_unit": unit,
        }  # fmt: skip
        if facts.interpolation_errors is not None:
            figures["interpolation"] = facts.interpolation_errors.facts
        if facts.quiet is not None:
            figures["quiet"] = [level.plain for level in quiet]
            figures["quiet_energy"] = facts.quiet.energy
    for warning in facts.warnings:
        say(f"warning: {warning}")
    say(
        f"{out}: {sampled.method}, {renderer.shape[0]} actuators, {renderer.shape[1] / view.sample_rate_hz:.3f} s, "
        f"{focus_points} focus points, largest drive {quantity(f'{renderer.peak_v:.3g}', view.drive_unit)}, "
        f"rms of the actuators up to {facts.dynamic_range_db:.1f} dB apart"
    )
    if focus_peak is not None:
        say(f"predicted response at the focus: up to {focus_peak:.3g} {unit}")
    if limiting.decided_by is not None:
        say(limited_words(limiting, rig_file))
    if options.tolerance_db is not None:
        what = "" if facts.omitted_bound else ": double precision"
        say(f"left out no more than {facts.omitted_bound:.3g} of the drives (relative L2, proved){what}")
    for level in quiet:
        say(f"quiet: {level}")
    if facts.interpolation_errors is not None:
        say(facts.interpolation_errors.words)
    if facts.quiet is not None:
        say(f"quiet places cost {facts.quiet.energy:.3g} times the energy of plain time reversal")
    if as_json:
        print(json.dumps(figures))


def _write_wav(bank: Bank, rig: RigConfig | None, shape: tuple[int, int], drive_file: Path, wav: Path) -> None:
    """Write the WAV file of a drive file; outputs of different full scale have a gain each."""
    # A bank made by other means holds no interface; then the WAV is in volts at the common rate.
    rate_hz, full_scale_v, each = 48_000, 1.0, np.ones(bank.actuators)
    if rig is not None:
        rate_hz, full_scale_v = rig.player.interface_rate_hz, rig.player.full_scale_v
        each = full_scale_v / interface_of(rig).full_scale_v
    with drive_pieces(drive_file) as pieces, progress("write WAV", shape[1]) as report:

        def shown() -> Iterator[Float64Array]:
            done = 0
            for piece in pieces:
                yield piece * each[:, np.newaxis]
                done += piece.shape[1]
                report(done, shape[1])

        stream_wav(
            wav, shown(), shape, float(bank.sample_rate_hz), interface_rate_hz=rate_hz, full_scale_v=full_scale_v
        )
    say(f"{wav}: {rate_hz} Hz, full scale {full_scale_v:g} V")
