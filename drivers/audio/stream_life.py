"""What a player knows of its stream's process and of the play under way there."""

from __future__ import annotations

import time
from collections.abc import Mapping

from drivers.driver_process import DriverProcess, ProcessGoneError
from drivers.errors import InstrumentLostError
from drivers.message_pipe import Message

LOST_REMEDY = "check its power, its cable and its driver or server, then reconnect"


def lost(name: str, doing: str, gone: ProcessGoneError) -> InstrumentLostError:
    """What to say of a player whose stream's process is gone."""
    return InstrumentLostError(name, doing, gone.cause, LOST_REMEDY)


class PlayUnderWay:
    """What is known of a play here; the stream's process tells how it ended."""

    def __init__(self, number: int, doing: str, length_s: float, asked_s: float) -> None:
        self.number = number
        self.doing = doing
        self.length_s = length_s
        self.asked_s = asked_s
        self.outcome: str | None = None
        self.notice = ""
        self.handed_frames = 0
        """Of a play that comes in pieces: how many frames the stream's process was given."""
        self.taken_frames = 0
        """And how many of them it has played."""


class StreamLife:
    """One life of the stream's process, and what it told."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self.opened: Message = {}
        self.play: PlayUnderWay | None = None
        self._heard_s = 0.0
        self.process = DriverProcess(
            "drivers.audio.player_process",
            "the process that owns its stream",
            environment,
            self._note,
            # PortAudio would start an audio server of its own where there is none.
            {"JACK_NO_START_SERVER": "1"},
        )

    def heard_after(self, instant_s: float) -> bool | None:
        """True when a sign of life came after an instant."""
        return True if self._heard_s > instant_s else None

    def _note(self, message: Message, payload: bytes) -> None:
        if message["is"] in ("open", "failed"):
            self.opened = message
        elif message["is"] == "here":
            self._heard_s = time.monotonic()
        elif message["is"] == "ended" and self.play is not None and message["number"] == self.play.number:
            self.play.notice = message["notice"]
            self.play.outcome = message["outcome"]
        elif message["is"] == "taken" and self.play is not None and message["number"] == self.play.number:
            self.play.taken_frames = message["frames"]
