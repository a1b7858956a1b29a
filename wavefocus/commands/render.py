"""``wavefocus render``: a scene into drive signals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Literal

import numpy as np

from calibration.bank import Bank, open_bank
from calibration.drive_file import Drive, write_drive
from calibration.errors import InputError
from rendering.drive import render_with_report
from rendering.render_report import RenderReport
from rendering.scene import Scene
from rendering.wav import write_wav
from wavefocus.compose import bank_configuration
from wavefocus.config.scene import load_scene
from wavefocus.console import progress, say

# A bank made by other means does not know the interface; then the WAV says volts at the common rate.
DEFAULT_INTERFACE_RATE_HZ = 48_000
DEFAULT_FULL_SCALE_V = 1.0


def render(
    scene_file: Path,
    bank: Path,
    out: Path,
    wav: Path | None,
    method: Literal["sampled", "exact"] | None,
    tolerance_db: float | None,
    *,
    as_json: bool,
) -> None:
    """Render a scene and write the drive file, and a WAV file when asked."""
    scene = load_scene(scene_file)
    with open_bank(bank) as view:
        drive, facts = rendered(scene_file, scene, view, method=method, tolerance_db=tolerance_db)
        if wav is not None:
            _write_wav(wav, drive, view)
    write_drive(out, drive)
    for warning in facts.warnings:
        say(f"warning: {warning}")
    samples = drive.drive_v.shape[1]
    peak_v = float(abs(drive.drive_v).max(initial=0.0))
    say(
        f"{out}: {drive.method}, {drive.drive_v.shape[0]} actuators, {samples / drive.sample_rate_hz:.3f} s, "
        f"{len(drive.focus_sample)} focus points, largest drive {peak_v:.3g} V"
    )
    if drive.scale < 1.0:
        say(f"scaled by {drive.scale:.4g} to stay within limit_v")
    if tolerance_db is not None:
        say(f"left out no more than {drive.omitted_bound:.3g} of the drives (relative L2, proved)")
    if as_json:
        figures = {
            "drive": str(out),
            "method": drive.method,
            "samples": samples,
            "start_s": drive.start_s,
            "focus_points": len(drive.focus_sample),
            "peak_v": peak_v,
            "scale": drive.scale,
            "omitted_bound": drive.omitted_bound,
            "warnings": list(facts.warnings),
        }
        print(json.dumps(figures))


def rendered(
    scene_file: Path,
    scene: Scene,
    bank: Bank,
    *,
    method: Literal["sampled", "exact"] | None = None,
    tolerance_db: float | None = None,
) -> tuple[Drive, RenderReport]:
    """Render a scene with progress; what is wrong with it is told with the file's name.

    Raises
    ------
    InputError
        The scene does not fit the bank.
    """
    with progress("render", 1) as report:
        try:
            return render_with_report(scene, bank, method=method, tolerance_db=tolerance_db, on_progress=report)
        except InputError as wrong:
            named = str(wrong) if str(bank.path) in str(wrong) else f"{scene_file}: {wrong}"
            raise InputError(named) from None


def _write_wav(path: Path, drive: Drive, bank: Bank) -> None:
    """Write the drives at the interface's rate, full scale being what the rig's player is calibrated to."""
    rate_hz, full_scale_v, drive_v = DEFAULT_INTERFACE_RATE_HZ, DEFAULT_FULL_SCALE_V, drive.drive_v
    if bank.rig_json is not None:
        player = bank_configuration(bank).rig.player
        rate_hz, full_scale_v = player.interface_rate_hz, player.full_scale_v
        # A file has one full scale; an output that has another gets so much more or less of it.
        each_v = np.array([player.output_full_scale_v[channel] for channel in player.channels])
        drive_v = drive_v * (full_scale_v / each_v)[:, np.newaxis]
    write_wav(path, drive_v, drive.sample_rate_hz, interface_rate_hz=rate_hz, full_scale_v=full_scale_v)
    say(f"{path}: {rate_hz} Hz, full scale {full_scale_v:g} V")
