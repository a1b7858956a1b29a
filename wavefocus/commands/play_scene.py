"""``wavefocus play SCENE.toml``: a scene on the rig's actuators, rendered while it sounds."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.durations import hours
from acquisition.engine.timeouts import BoundedPlayer
from config.rig import RigConfig
from rendering.drive.streamed_drive import StreamedDrive
from rendering.drive.wav import InterfaceRate
from rendering.scene.loading import load_scene
from rendering.scene.model import Scene
from storage.bank.reading import Bank, open_bank
from storage.errors import InputError
from wavefocus.console import progress, say
from wavefocus.ended_by_input import ended_by_input
from wavefocus.ending_at_once import ending_at_once
from wavefocus.exits import Exit
from wavefocus.render_options import RenderOptions
from wavefocus.rig.render_rig import interface_of, limited_words, rig_of, within
from wavefocus.rig.rig_limits import PLAYED_UNITS
from wavefocus.rig.sounding import open_player

AHEAD_S = 2.0
"""So much is rendered before it is heard: many times what a render takes, short enough to wait for."""
PIECES_AHEAD = 8
MOST_PIECE_SAMPLES = 4096
LATE_S = 10.0


@dataclass(frozen=True, slots=True)
class Latency:
    """How long before it is heard a sample of a source has to be known, and what that is made of.

    Parameters
    ----------
    lookahead_s : float
        Samples of a source that a drive sample is made of come up to so much later: the length of the Green's
        functions, which time reversal needs, the renderer's blocks, and the conversion to the interface's rate.
    ahead_s : float
        What is rendered and waits to be played.
    interface_s : float
        What the interface says of itself.
    """

    lookahead_s: float
    ahead_s: float
    interface_s: float

    @property
    def whole_s(self) -> float:
        """All of it."""
        return self.lookahead_s + self.ahead_s + self.interface_s

    def __str__(self) -> str:
        return (
            f"latency {1e3 * self.whole_s:.0f} ms: {1e3 * self.lookahead_s:.0f} ms of looking ahead in the scene,"
            f" {1e3 * self.ahead_s:.0f} ms rendered ahead, {1e3 * self.interface_s:.0f} ms in the interface"
        )


def play_scene(
    scene_file: Path,
    bank: Path,
    rig_file: Path,
    *,
    options: RenderOptions,
    gain_db: float,
    ahead_s: float,
    as_json: bool,
    watched: bool = False,
    allow_large: bool = False,
) -> Exit:
    """Render a scene once to find its scale, then once more while it is played.

    Where it is `watched`, it ends when standard input closes, muted.

    Returns
    -------
    Exit
        `Exit.STOPPED` where a person ended it, else `Exit.DONE`.

    Raises
    ------
    InputError
        The scene does not fit the bank, or the bank not the rig.
    InstrumentError
        The interface failed, or ran dry because rendering did not keep up; it was muted.
    """
    scene = load_scene(scene_file, allow_large=allow_large)
    with open_bank(bank) as view:
        view.require_sound()
        if view.drive_unit not in PLAYED_UNITS:
            raise InputError(f"{bank} takes drives in {view.drive_unit}, and the player plays volts")
        rig = rig_of(rig_file, view)
        assert rig is not None  # one that is named is there
        try:
            with ending_at_once(), ended_by_input() if watched else nullcontext():
                figures = _play(within(scene, rig), view, rig, rig_file, options, gain_db, ahead_s, watched=watched)
        except KeyboardInterrupt:
            say("stopped by the user; the outputs are muted")
            return Exit.STOPPED
        except InputError as wrong:
            named = str(wrong) if str(view.path) in str(wrong) else f"{scene_file}: {wrong}"
            raise InputError(named) from None
    say(f"{scene_file}: played; the outputs are muted")
    if as_json:
        print(json.dumps({"scene": str(scene_file), "gain_db": gain_db, **figures}))
    return Exit.DONE


def _play(
    scene: Scene,
    bank: Bank,
    rig: RigConfig,
    rig_file: Path,
    options: RenderOptions,
    gain_db: float,
    ahead_s: float,
    *,
    watched: bool,
) -> dict[str, object]:
    rate_hz = float(bank.sample_rate_hz)
    block_samples = max(1, min(MOST_PIECE_SAMPLES, round(ahead_s * rate_hz / PIECES_AHEAD)))
    streamed = StreamedDrive(
        scene,
        bank,
        interface=interface_of(rig),
        gain=10.0 ** (gain_db / 20.0),
        block_samples=block_samples,
        method=options.method,
        tolerance_db=options.tolerance_db,
        interpolation_tolerance=options.interpolation_tolerance,
    )
    actuators, samples = streamed.shape
    begun_s = time.monotonic()
    with progress("first pass", samples) as report:
        facts = streamed.prepare(report)
    prepared_s = time.monotonic() - begun_s
    for warning in facts.warnings:
        say(f"warning: {warning}")
    if facts.limiting.decided_by is not None:
        say(limited_words(facts.limiting, rig_file))
    rate = InterfaceRate(rate_hz, rig.player.interface_rate_hz)
    looked_ahead = streamed.live.latency_samples + 2 * block_samples + rate.around_samples
    with open_player(rig) as (player, _):
        latency = Latency(looked_ahead / rate_hz, ahead_s, player.latency_s)
        seconds = samples / rate_hz
        say(f"{player.identify()}: {hours(seconds)} on {actuators} actuators, at most {streamed.peak_v:.3g} V")
        if watched:
            print(json.dumps({"event": "playing", "seconds": seconds}), flush=True)
        say(f"found the scale in {prepared_s:.1f} s; {latency}")
        pieces = rate.pieces(streamed.blocks(), actuators, samples, block_samples)
        least_s = _sounding(player, rig, pieces, ahead_s, seconds)
    if least_s is not None:
        say(f"rendering was never less than {1e3 * least_s:.0f} ms ahead of what was heard")
    return {
        "seconds": seconds,
        "peak_v": streamed.peak_v,
        "scale": facts.scale,
        "limited_by": facts.limiting.decided_by,
        "prepared_s": round(prepared_s, 3),
        "latency_ms": round(1e3 * latency.whole_s, 1),
        "lookahead_ms": round(1e3 * latency.lookahead_s, 1),
        "ahead_ms": round(1e3 * latency.ahead_s, 1),
        "interface_ms": round(1e3 * latency.interface_s, 1),
        "least_ahead_ms": None if least_s is None else round(1e3 * least_s, 1),
    }


def _sounding(
    player: BoundedPlayer, rig: RigConfig, pieces: Iterable[NDArray[np.float64]], ahead_s: float, seconds: float
) -> float | None:
    """Play the pieces as they come; tells how little was waiting at worst, None if all fitted before it sounded."""
    interface_rate_hz = rig.player.interface_rate_hz
    least_s: float | None = None
    handed_s, whole_s = 0.0, math.ceil(seconds)
    player.begin_pieces(rig.player.channels, interface_rate_hz, ahead_s)
    with progress("play", whole_s, timed=False) as report:
        for piece in pieces:
            waiting_s = player.add_piece(piece)
            if handed_s >= ahead_s:
                least_s = waiting_s if least_s is None else min(least_s, waiting_s)
            handed_s += piece.shape[1] / interface_rate_hz
            report(int(max(0.0, min(handed_s - ahead_s, seconds))), whole_s, "seconds")
        player.end_pieces()
        player.wait(1.1 * ahead_s + player.latency_s + LATE_S)
        report(whole_s, whole_s, "seconds")
    return least_s
