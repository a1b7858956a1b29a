"""``wavefocus pause``, ``go-on`` and ``stop``: orders to the process that owns a bank."""

from __future__ import annotations

import json
import time
from pathlib import Path

from acquisition.durations import hours
from storage.bank.owner import Owner, bank_owner
from storage.errors import InputError
from wavefocus.campaign.heartbeat import Heartbeat, read_heartbeat
from wavefocus.campaign.orders import give_order, withdraw
from wavefocus.console import say
from wavefocus.exits import Exit

# The states in which an order is carried out, and those in which it will be, in words.
CARRIED_OUT = {"pause": ("paused",), "go-on": ("running",), "stop": ("stopped", "finished", "failed")}
LOOKS_EVERY_S = 0.1


def order(bank: Path, word: str, wait_s: float, *, as_json: bool) -> Exit:
    """Give an order and wait until it is carried out, or at least heard.

    Parameters
    ----------
    bank : Path
        Whose capture.
    word : str
        ``"pause"``, ``"go-on"`` or ``"stop"``.
    wait_s : float
        Longest wait.
    as_json : bool
        Tell programs.

    Returns
    -------
    Exit
        ``DONE`` when the capture has heard the order, ``NOT_GOOD_ENOUGH`` when it does not answer.

    Raises
    ------
    InputError
        No process owns the bank.
    """
    owner = _owner(bank, word)
    given = give_order(bank, word)
    until_s = time.monotonic() + wait_s
    heard, carried_out = None, False
    while not carried_out:
        beat = read_heartbeat(bank)
        if beat is not None and beat.order == given.number:
            heard = beat
            carried_out = beat.state in CARRIED_OUT[word]
        gone = bank_owner(bank) is None
        if gone:
            carried_out = carried_out or (word == "stop" and heard is not None)
            break
        if time.monotonic() >= until_s:
            break
        if not carried_out:
            time.sleep(LOOKS_EVERY_S)
    if heard is None:
        withdraw(bank, given)
    line = _line(bank, owner, heard, wait_s, carried_out=carried_out)
    say(line)
    if as_json:
        state = None if heard is None else heard.state
        print(json.dumps({"order": word, "heard": heard is not None, "carried_out": carried_out, "state": state}))
    return Exit.DONE if heard is not None else Exit.NOT_GOOD_ENOUGH


def _owner(bank: Path, word: str) -> Owner:
    owner = bank_owner(bank)
    if owner is None:
        raise InputError(
            f"{bank}: no process owns the bank, so there is nothing to {word.replace('go-on', 'go on with')}"
        )
    return owner


def _line(bank: Path, owner: Owner, heard: Heartbeat | None, wait_s: float, *, carried_out: bool) -> str:
    who = f"process {owner.pid} on {owner.host}"
    if heard is None:
        beat = read_heartbeat(bank)
        silent = "" if beat is None else f"; its last sign of life is {hours(beat.age_s())} old"
        return f"{bank}: {who} does not answer within {wait_s:g} s{silent}; the order is withdrawn"
    if carried_out:
        return f"{bank}: {who}: {heard.state}: {heard.reason}"
    return f"{bank}: {who} has heard it and is {heard.state}: {heard.reason}; wavefocus status tells when it is done"
