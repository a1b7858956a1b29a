"""What outputs there are, asked in a process of its own: a broken driver can hang whoever asks it."""

from __future__ import annotations

import time
from collections.abc import Mapping

from drivers.audio.devices import OutputDevice
from drivers.audio.messages import Message
from drivers.audio.stream_process import OPENING_S, ProcessGoneError, StreamProcess
from drivers.errors import InstrumentError

NAME = "player"
DOING = "listing outputs"


def list_outputs(environment: Mapping[str, str] | None = None) -> tuple[tuple[OutputDevice, ...], tuple[str, ...]]:
    """All outputs that PortAudio offers, and the names of its host APIs.

    Parameters
    ----------
    environment : mapping from str to str, optional
        As of `drivers.audio.stream_player.StreamPlayer`.

    Raises
    ------
    InstrumentError
        PortAudio is missing, or a driver hangs.
    """
    answers: list[Message] = []
    process = StreamProcess(environment or {}, answers.append)
    try:
        process.send(({"do": "list"}, b""))
        answer = process.wait_for(lambda: answers[0] if answers else None, time.monotonic() + OPENING_S)
    except ProcessGoneError as gone:
        raise InstrumentError(NAME, DOING, gone.cause, "see whether PortAudio works at all") from None
    finally:
        process.close()
    if answer is None:
        raise InstrumentError(NAME, DOING, f"no answer in {OPENING_S:g} s", "unplug audio devices whose driver hangs")
    if answer["is"] == "failed":
        raise InstrumentError(NAME, DOING, answer["cause"], answer["remedy"])
    return tuple(OutputDevice(**one) for one in answer["devices"]), tuple(answer["host_apis"])
