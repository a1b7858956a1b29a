"""``wavefocus play``: a drive on the rig's actuators, live."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.durations import hours
from config.rig import RigConfig, default_rig
from drivers.protocols import Clock
from storage.drive_file import Drive, read_drive
from storage.errors import InputError
from wavefocus.configuration import load_rig
from wavefocus.console import Report, progress, say
from wavefocus.ended_by_input import ended_by_input
from wavefocus.ending_at_once import ending_at_once
from wavefocus.exits import Exit
from wavefocus.rig.rig_limits import check_drive
from wavefocus.rig.sounding import open_player
from wavefocus.unverified import name_unverified

# What the player's process holds is kept in memory whole, so that nothing but a play that fits is begun.
MOST_BYTES = 4 * 2**30
TELL_EVERY_S = 0.2
# A play may take longer than its signal by the interface's latency and what opening a stream takes.
LATE_S = 10.0


def play(drive_file: Path, rig_file: Path, *, loop: int, gain_db: float, as_json: bool, watched: bool = False) -> Exit:
    """Play a drive file as one finite signal, several times without a gap where asked for.

    Where it is `watched`, it ends when standard input closes, muted: whoever started it is gone, or wants it to end.

    Returns
    -------
    Exit
        `Exit.STOPPED` where a person ended it, else `Exit.DONE`.

    Raises
    ------
    InputError
        The drive does not fit the rig, or would give an actuator more than it may get.
    InstrumentError
        The interface failed; it was muted.
    """
    rig = default_rig() if str(rig_file) == "virtual" else load_rig(rig_file)
    drive = read_drive(drive_file)
    name_unverified(drive_file, verified=drive.verified)
    if gain_db:
        drive = replace(drive, drive_v=drive.drive_v * 10.0 ** (gain_db / 20.0))
    actuators, samples = drive.drive_v.shape
    if actuators != len(rig.player.channels):
        raise InputError(
            f"{drive_file} is for {actuators} actuators, {rig_file} has {len(rig.player.channels)}; render it from a"
            " bank of this rig"
        )
    remedy = "use --gain-db {gain_db}, or set output.limit_v and limit_rms_v in the scene and render again"
    check_drive(drive, rig.player, str(drive_file), remedy, repeated=loop > 1, gain_db=gain_db)
    needed = _bytes_needed(drive, loop, rig)
    if needed > MOST_BYTES:
        raise InputError(
            f"{drive_file}: {loop} times {samples / drive.sample_rate_hz:.4g} s on {actuators} actuators take"
            f" {needed / 2**30:.3g} GiB at once, and {MOST_BYTES / 2**30:.3g} GiB are allowed: lower --loop, or play"
            " the scene itself, with --bank: then it is rendered while it sounds"
        )
    seconds = loop * samples / drive.sample_rate_hz
    peak_v = float(np.abs(drive.drive_v).max())
    try:
        with ending_at_once(), ended_by_input() if watched else nullcontext(), open_player(rig) as (player, clock):
            times = f"{loop} times, " if loop > 1 else ""
            memory = f"{needed / 2**20:.0f} MB of memory"
            say(
                f"{player.identify()}: {times}{hours(seconds)} on {actuators} actuators, at most {peak_v:.3g} V,"
                f" {memory}"
            )
            if watched:
                print(json.dumps({"event": "playing", "seconds": seconds}), flush=True)
            signals_v = {
                channel: _repeated(volts, loop)
                for channel, volts in zip(rig.player.channels, drive.drive_v, strict=True)
            }
            with progress("play", math.ceil(seconds), timed=False) as report:
                player.play(signals_v, drive.sample_rate_hz)
                with _told(report, clock, seconds):
                    player.wait(1.1 * seconds + LATE_S)
                report(math.ceil(seconds), math.ceil(seconds), "seconds")
    except KeyboardInterrupt:
        say("stopped by the user; the outputs are muted")
        return Exit.STOPPED
    say(f"{drive_file}: played; the outputs are muted")
    if as_json:
        figures = {"drive": str(drive_file), "seconds": seconds, "loops": loop, "peak_v": peak_v, "gain_db": gain_db}
        print(json.dumps(figures))
    return Exit.DONE


def _bytes_needed(drive: Drive, loop: int, rig: RigConfig) -> int:
    """Volts in float64, as they are here and as the player keeps them, and the interface's frames in float32, twice."""
    actuators, samples = drive.drive_v.shape
    frames = samples * rig.player.interface_rate_hz / drive.sample_rate_hz
    return int(actuators * (8 * samples + loop * (2 * 8 * samples + 2 * 4 * frames)))


def _repeated(volts: NDArray[np.float64], loop: int) -> NDArray[np.float64]:
    return volts if loop == 1 else np.tile(volts, loop)


@contextmanager
def _told(report: Report, clock: Clock, seconds: float) -> Iterator[None]:
    """Tell how far a play is, by the clock, while the calling thread waits for its end."""
    started_s, over = clock.now_s(), threading.Event()

    def tell() -> None:
        while not over.wait(TELL_EVERY_S):
            played_s = min(clock.now_s() - started_s, seconds)
            report(int(played_s), math.ceil(seconds), "seconds")

    teller = threading.Thread(target=tell, name="play progress", daemon=True)
    teller.start()
    try:
        yield
    finally:
        over.set()
        teller.join()
