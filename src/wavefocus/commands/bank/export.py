"""``wavefocus export``: a bank in the formats of other fields."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

from wavefocus.banks import Export, export_bank
from wavefocus.console import answer, progress, say
from wavefocus.input_files import parse_positions
from wavefocus.storage.bank.reading import open_bank

_WITH_LIST = ("files", "bytes", "publication")
_NOT_IN_JSON = ("sample_rate_hz", "response_unit")


def export(bank: Path, out: Path, to: Any, *, positions: str, only_list: bool, as_json: bool, **options: Any) -> None:
    """Write a bank, or some rows of it, in another format; or only list what would be written.

    options: As of `wavefocus.export_bank`.

    Raises InputError: the bank cannot be read or does not fit the format, or a file to be written must stay.
    """
    with open_bank(bank) as view, nullcontext() if only_list else progress("export", 1) as report:
        wanted = parse_positions(positions, view.positions) if positions else None
        made = export_bank(view, out, to, positions=wanted, only_list=only_list, on_progress=report, **options)
    _report(made, only_list=only_list, as_json=as_json)


def _report(made: Export, *, only_list: bool, as_json: bool) -> None:
    for count, fate in ((made.left_out, "left out"), (made.nan, "NaN")):
        if count:
            say(f"{count} positions are not measured, failed or disabled and are {fate}")
    if "licence" not in made.publication:
        say("no licence is stated: give one in [publication] of a TOML file, and name it with --publication")
    if as_json:
        left_out = _NOT_IN_JSON if only_list else _NOT_IN_JSON + _WITH_LIST
        print(json.dumps({key: value for key, value in asdict(made).items() if key not in left_out}, default=str))
        return
    content = f"{made.positions} positions, {made.actuators} actuators, {made.taps} taps, {made.response_unit}"
    if not only_list:
        say(f"{made.out}: {content}")
        return
    size = f"about {made.bytes / 1e6:.3g} MB in {len(made.files)} file(s)"
    answer(f"{made.out}: {content}, {made.sample_rate_hz:g} Hz; {size}")
    for key, text in made.publication.items():
        answer(f"{key}: {' '.join(text.split())}")
