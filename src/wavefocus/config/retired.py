"""Commands, options and keys of earlier versions that are gone, and what serves instead."""

from collections.abc import Sequence

_SHELL = "a shell carries out commands one after the other, see docs/how-to/several-runs.md"
_CHOSEN = "choose the schedule in [capture]; capture measures one position both ways and states the difference"

COMMANDS = {
    "publish": "wavefocus export writes a bank for others; docs/how-to/publish.md lists what to upload",
    "queue": _SHELL,
    "go-on": "wavefocus resume lets a paused capture go on",
    "service": "the system's own scheduler starts wavefocus resume, see docs/how-to/several-runs.md",
    "bench choose": "wavefocus bench render and bench estimate show error against run time",
    "bench symptoms": "wavefocus verify names the causes that it measures",
}
OPTIONS = {
    "--documents": "BANK.events.jsonl next to the bank has every event of a session",
    "--stream": "render always writes block by block",
    "--pilot": "choose [grid] spacing_mm, and check_positions to measure the error between positions",
    "--pilot-positions": "choose [grid] spacing_mm, and check_positions to measure the error between positions",
}
KEYS = {
    "refine_to": "choose spacing_mm; check_positions measures the error between positions",
    "refine_positions": "choose spacing_mm; wavefocus extend adds positions to a bank",
    "response_error": "the response at the focus is that of time reversal",
    "when_staggered_does_not_pay": _CHOSEN,
    "allowed_loss_db": _CHOSEN,
    "x_position": "take settle_s from the mirror's data sheet",
    "y_position": "take settle_s from the mirror's data sheet",
}


def refused(word: str, instead: str) -> str:
    """The sentence that refuses a word of an earlier version."""
    return f"{word} is gone: {instead}"


def retired_command(words: Sequence[str]) -> str:
    """The sentence about a command line that begins with a command of an earlier version; else an empty text."""
    for name in (" ".join(words[:2]), *words[:1]):
        if name in COMMANDS:
            return refused(name, COMMANDS[name])
    return ""
