"""``wavefocus play``: drives, or a scene rendered while it is played, on the rig's actuators."""

from __future__ import annotations

import json
import math
import tempfile
import time
from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import replace
from itertools import repeat
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wavefocus.acquisition.wording import hours
from wavefocus.config.messages.codec import to_line
from wavefocus.config.messages.operate import DrivePlaying
from wavefocus.config.rig import RigConfig
from wavefocus.configuration import named_rig
from wavefocus.console import print_line, progress, say, spinner
from wavefocus.drivers.timeouts import BoundedPlayer
from wavefocus.drives import naming
from wavefocus.ending import ended_by_input, ending_at_once
from wavefocus.exits import Exit
from wavefocus.input_files import name_unverified
from wavefocus.rendering.drive.rendering import SceneRenderer
from wavefocus.rendering.drive.wav import InterfaceRate
from wavefocus.rendering.field.quiet_levels import rendered_levels
from wavefocus.rendering.scene.model import Scene, load_scene
from wavefocus.rig.limits import check_drive, interface_of, limited_words, rig_of, within
from wavefocus.rig.setup import open_player
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.drive_file import drive_pieces, read_drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.units import PLAYED_UNITS

# A play may take longer than its signal by the interface's latency and what opening a stream takes.
LATE_S = 10.0


def play(
    what: Path,
    bank: Path | None,
    rig_file: Path,
    *,
    loop: int,
    gain_db: float,
    as_json: bool,
    watched: bool,
) -> Exit:
    """Play a drive file or, with a bank, a scene file.

    Raises InputError: the file is of the other kind, or is to be played as it cannot be; and as `play_drive`.
    """
    if bank is None:
        if what.suffix.lower() == ".toml":
            raise InputError(f"{what}: a scene needs a bank to be rendered from; add --bank BANK.h5")
        return play_drive(what, rig_file, loop=loop, gain_db=gain_db, as_json=as_json, watched=watched)
    if what.suffix.lower() == ".h5":
        raise InputError(f"{what}: a drive file is played as it is; leave out --bank, or give the scene file")
    if loop > 1:
        raise InputError("--loop is for drive files; render the scene to one, or let its path have more turns")
    scene = load_scene(what, allow_large=True)
    return play_scene(scene, what, bank, rig_file, gain_db=gain_db, as_json=as_json, watched=watched)


def play_drive(
    drive_file: Path, rig_file: Path, *, loop: int, gain_db: float, as_json: bool, watched: bool = False
) -> Exit:
    """Play a drive file, several times without a gap where asked for.

    Where it is `watched`, it ends when standard input closes, muted: its starter is gone, or wants it to end.

    Raises InputError: the drive does not fit the rig, or would give an actuator more than it may get. Raises
    InstrumentError: the interface failed; it was muted.
    """
    rig = named_rig(rig_file)
    drive = read_drive(drive_file)
    name_unverified(drive_file, verified=drive.verified)
    drive_v = drive.drive_v * 10.0 ** (gain_db / 20.0)
    actuators, samples = drive_v.shape
    if actuators != len(rig.player.channels):
        raise InputError(
            f"{drive_file} is for {actuators} actuators, {rig_file} has {len(rig.player.channels)}; render it from a"
            " bank of this rig"
        )
    remedy = "use --gain-db {gain_db}, or set output.limit_v and limit_rms_v in the scene and render again"
    drive = replace(drive, drive_v=drive_v)
    check_drive(drive, rig.player, str(drive_file), remedy, repeated=loop > 1, gain_db=gain_db)
    rate = InterfaceRate(drive.sample_rate_hz, rig.player.interface_rate_hz)
    seconds, peak_v = loop * samples / drive.sample_rate_hz, float(np.abs(drive_v).max())
    try:
        with ending_at_once(), ended_by_input() if watched else nullcontext(), open_player(rig) as player:
            times = f"{loop} times, " if loop > 1 else ""
            say(f"{player.identify()}: {times}{hours(seconds)} on {actuators} actuators, at most {peak_v:.3g} V")
            if watched:
                print_line(to_line(DrivePlaying(seconds)))
            pieces = rate.pieces(repeat(drive_v, loop), actuators, loop * samples, piece_samples(drive.sample_rate_hz))
            _sounding(player, rig, pieces, seconds)
    except KeyboardInterrupt:
        say("stopped by the user; the outputs are muted")
        return Exit.STOPPED
    say(f"{drive_file}: played; the outputs are muted")
    if as_json:
        figures = {"drive": str(drive_file), "seconds": seconds, "loops": loop, "peak_v": peak_v, "gain_db": gain_db}
        print(json.dumps(figures))
    return Exit.DONE


AHEAD_S = 2.0
"""So much is handed over before it sounds."""
PIECES_AHEAD = 8
MAX_PIECE_SAMPLES = 4096
BETWEEN_SAMPLES = 1.001
"""A repetition is sampled at other phases than what was rendered: a sine of frequency f reaches up to
(pi f / rate)^2 / 2 more between samples, 0.0009 at 640 Hz and 48 kHz. So much is held at full scale; what is beyond the
player refuses."""


def piece_samples(rate_hz: float) -> int:
    """Samples of drive that are handed over at a time."""
    return max(1, min(MAX_PIECE_SAMPLES, round(AHEAD_S * rate_hz / PIECES_AHEAD)))


def play_scene(
    scene: Scene, scene_file: Path, bank: Path, rig_file: Path, *, gain_db: float, as_json: bool, watched: bool
) -> Exit:
    """Render a scene into a temporary drive file, and play that.

    Where it is `watched`, it ends when standard input closes, muted.

    Raises InputError: the scene does not fit the bank, or the bank not the rig. Raises InstrumentError: the interface
    failed, or ran dry because rendering did not keep up; it was muted.
    """
    with open_bank(bank) as view:
        with spinner("verifying the rows of the bank"):
            view.require_sound()
        if view.drive_unit not in PLAYED_UNITS:
            raise InputError(f"{bank} takes drives in {view.drive_unit}, and the player plays volts")
        rig = rig_of(rig_file, view)
        assert rig is not None  # one that is named is there
        try:
            with (
                naming(scene_file, view), ending_at_once(), ended_by_input() if watched else nullcontext(),
                tempfile.TemporaryDirectory(prefix="wavefocus-") as folder,
            ):  # fmt: skip
                drive_file, limited = Path(folder) / "drive.h5", within(scene, rig)
                figures = _play(limited, view, rig, rig_file, drive_file, gain_db, watched=watched)
        except KeyboardInterrupt:
            say("stopped by the user; the outputs are muted")
            return Exit.STOPPED
    say(f"{scene_file}: played; the outputs are muted")
    if as_json:
        print(json.dumps({"scene": str(scene_file), "gain_db": gain_db, **figures}))
    return Exit.DONE


def _play(
    scene: Scene,
    bank: Bank,
    rig: RigConfig,
    rig_file: Path,
    drive_file: Path,
    gain_db: float,
    *,
    watched: bool,
) -> dict[str, object]:
    rate_hz = float(bank.sample_rate_hz)
    with spinner("preparing the scene: its interpolation and quiet places"):
        renderer = SceneRenderer(scene, bank, interface=interface_of(rig), gain=10.0 ** (gain_db / 20.0))
    actuators, samples = renderer.shape
    begun_s = time.monotonic()
    with progress("render", samples) as report:
        facts = renderer.write(drive_file, report)
    prepared_s = time.monotonic() - begun_s
    for warning in facts.warnings:
        say(f"warning: {warning}")
    quiet = rendered_levels(facts.quiet_tracks)
    for level in quiet:
        say(f"quiet: {level}")
    if facts.limiting.decided_by is not None:
        say(limited_words(facts.limiting, rig_file))
    rate = InterfaceRate(rate_hz, rig.player.interface_rate_hz)
    with drive_pieces(drive_file) as rendered, open_player(rig) as player:
        seconds = samples / rate_hz
        say(f"{player.identify()}: {hours(seconds)} on {actuators} actuators, at most {renderer.peak_v:.3g} V")
        if watched:
            print_line(to_line(DrivePlaying(seconds)))
        say(f"rendered in {prepared_s:.1f} s")
        pieces = rate.pieces(rendered, actuators, samples, piece_samples(rate_hz))
        least_s = _sounding(player, rig, pieces, seconds)
    if least_s is not None:
        say(f"reading was never less than {1e3 * least_s:.0f} ms ahead of the sound")
    return {
        **({"quiet": [level.plain for level in quiet]} if quiet else {}),
        "seconds": seconds,
        "peak_v": renderer.peak_v,
        "scale": facts.scale,
        "limited_by": facts.limiting.decided_by,
        "prepared_s": round(prepared_s, 3),
        "ahead_ms": round(1e3 * AHEAD_S, 1),
        "least_ahead_ms": None if least_s is None else round(1e3 * least_s, 1),
    }


def _sounding(
    player: BoundedPlayer, rig: RigConfig, pieces: Iterable[NDArray[np.float64]], seconds: float
) -> float | None:
    """Play the pieces as they come; returns the smallest reserve, None if all fitted before it sounded."""
    interface_rate_hz = rig.player.interface_rate_hz
    least_s: float | None = None
    handed_s, whole_s = 0.0, math.ceil(seconds)
    full_scale_v = np.array([rig.player.output_full_scale_v[channel] for channel in rig.player.channels])[:, None]
    player.begin_pieces(rig.player.channels, interface_rate_hz, AHEAD_S)
    with progress("play", whole_s, timed=False) as report:
        for piece in pieces:
            held_v = np.clip(piece, -full_scale_v, full_scale_v)
            waiting_s = player.add_piece(np.where(np.abs(piece) <= BETWEEN_SAMPLES * full_scale_v, held_v, piece))
            if handed_s >= AHEAD_S:
                least_s = waiting_s if least_s is None else min(least_s, waiting_s)
            handed_s += piece.shape[1] / interface_rate_hz
            report(int(max(0.0, min(handed_s - AHEAD_S, seconds))), whole_s, "seconds")
        player.end_pieces()
        player.wait(1.1 * AHEAD_S + player.latency_s + LATE_S)
        report(whole_s, whole_s, "seconds")
    return least_s
