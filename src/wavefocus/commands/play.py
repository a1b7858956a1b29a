"""``wavefocus play``: drives on the rig's actuators."""

import json
import math
from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import replace
from itertools import repeat
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wavefocus.acquisition.wording import hours
from wavefocus.config.messages import to_line
from wavefocus.config.messages.operate import DrivePlaying
from wavefocus.config.rig import RigConfig
from wavefocus.configuration import named_rig
from wavefocus.console import Exit, print_line, progress, say
from wavefocus.drivers.timeouts import BoundedPlayer
from wavefocus.ending import ended_by_input, ending_at_once
from wavefocus.input_files import name_unverified
from wavefocus.rendering.drive.wav import InterfaceRate
from wavefocus.rig.limits import check_drive
from wavefocus.rig.setup import open_player
from wavefocus.storage.drive_file import read_drive
from wavefocus.storage.errors import InputError

# A play may take longer than its signal by the interface's latency and what opening a stream takes.
LATE_S = 10.0


def play(drive_file: Path, rig_file: Path, *, loop: int, gain_db: float, as_json: bool, watched: bool) -> Exit:
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
            lasts = f"{seconds:.3g} s" if seconds < 10 else hours(seconds)
            say(f"{player.identify()}: {times}{lasts} on {actuators} actuators, at most {peak_v:.3g} V")
            if watched:
                print_line(to_line(DrivePlaying(seconds)))
            at_once = max(1, min(4096, round(AHEAD_S * drive.sample_rate_hz / 8)))
            pieces = rate.pieces(repeat(drive_v, loop), actuators, loop * samples, at_once)
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
BETWEEN_SAMPLES = 1.001
"""A repetition is sampled at other phases than what was rendered: a sine of frequency f reaches up to
(pi f / rate)^2 / 2 more between samples, 0.0009 at 640 Hz and 48 kHz. So much is held at full scale; what is beyond the
player refuses."""


def _sounding(player: BoundedPlayer, rig: RigConfig, pieces: Iterable[NDArray[np.float64]], seconds: float) -> None:
    """Play the pieces as they come."""
    interface_rate_hz = rig.player.interface_rate_hz
    handed_s, whole_s = 0.0, math.ceil(seconds)
    full_scale_v = np.array([rig.player.output_full_scale_v[channel] for channel in rig.player.channels])[:, None]
    player.begin_pieces(rig.player.channels, interface_rate_hz, AHEAD_S)
    with progress("play", whole_s, timed=False) as report:
        for piece in pieces:
            held_v = np.clip(piece, -full_scale_v, full_scale_v)
            player.add_piece(np.where(np.abs(piece) <= BETWEEN_SAMPLES * full_scale_v, held_v, piece))
            handed_s += piece.shape[1] / interface_rate_hz
            report(int(max(0.0, min(handed_s - AHEAD_S, seconds))), whole_s, "seconds")
        player.end_pieces()
        player.wait(1.1 * AHEAD_S + player.latency_s + LATE_S)
        report(whole_s, whole_s, "seconds")
