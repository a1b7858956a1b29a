"""The interface alone, opened to be heard: muted on every way out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from acquisition.engine.timeouts import BoundedPlayer
from config.rig import RigConfig
from drivers.protocols import Clock
from wavefocus.console import say
from wavefocus.rig.instruments import openers


@contextmanager
def open_player(rig: RigConfig) -> Iterator[tuple[BoundedPlayer, Clock]]:
    """Open the interface alone; whatever happens, its outputs are muted and released on the way out."""
    ways = openers(rig)
    player = BoundedPlayer(ways.player(), rig.recovery.hung_after_s)
    try:
        yield player, ways.clock
    except BaseException:
        # The first failure is the one to act on; what else fails on the way out is told and does not hide it.
        for step in (player.mute, player.close):
            try:
                step()
            except Exception as failure:
                say(f"on the way out: {failure}")
        raise
    try:
        player.mute()
    finally:
        player.close()
