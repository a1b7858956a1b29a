"""``wavefocus note``: a dated note in a bank."""

import json
from dataclasses import asdict
from pathlib import Path

from wavefocus.console import say
from wavefocus.storage.bank.notes import add_note


def note(bank: Path, text: str, *, as_json: bool) -> None:
    """Add a note with the time of now; InputError where it cannot be."""
    added = add_note(bank, text)
    say(f"{bank}: noted at {added.at}")
    if as_json:
        print(json.dumps({"bank": str(bank), **asdict(added)}))
