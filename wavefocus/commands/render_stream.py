"""``wavefocus render --stream``: drives of any length, written while they are made."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from config.rig import RigConfig
from rendering.drive.streamed_drive import StreamedDrive
from rendering.drive.wav import stream_wav
from rendering.scene.model import Scene
from rendering.scene.size import check_scene_size, size_words
from storage.bank.reading import Bank
from storage.drive_file import DriveAbout, drive_in_blocks
from storage.errors import InputError
from storage.units import quantity
from wavefocus.console import progress, say
from wavefocus.render_options import RenderOptions
from wavefocus.rig.render_rig import DEFAULT_FULL_SCALE_V, DEFAULT_INTERFACE_RATE_HZ, interface_of, limited_words

Float64Array = NDArray[np.float64]

MOST_WHOLE_BYTES = 2 * 2**30
"""Drives that take more are streamed without being asked: 22 minutes on 20 actuators at 10 kHz."""


def too_large(scene_file: Path, scene: Scene, bank: Bank) -> bool:
    """Whether the drives of a scene had better not be held in memory whole.

    Raises
    ------
    InputError
        The scene is larger than it is allowed to be.
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

    Raises
    ------
    InputError
        The scene does not fit the bank, or a drive is beyond the interface's full scale.
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
