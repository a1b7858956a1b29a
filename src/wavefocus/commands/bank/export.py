"""``wavefocus export``: a bank in the formats of other fields."""

import json
from dataclasses import asdict
from pathlib import Path

from wavefocus.banks import export_by_options
from wavefocus.console import progress, say
from wavefocus.input_files import parse_positions
from wavefocus.options import ExportOptions
from wavefocus.storage.bank.reading import open_bank

_NOT_IN_JSON = ("sample_rate_hz", "response_unit", "files", "bytes", "publication")


def export(
    bank: Path, out: Path, to: str, *, positions: str, options: ExportOptions, force: bool, as_json: bool
) -> None:
    """Write a bank, or some rows of it, in another format.

    Raises InputError: the bank cannot be read or does not fit the format, or a file to be written must stay.
    """
    with open_bank(bank) as view, progress("export", 1) as report:
        wanted = parse_positions(positions, view.positions) if positions else None
        made = export_by_options(view, out, to, options, wanted, report, force=force)
    for count, fate in ((made.left_out, "left out"), (made.nan, "NaN")):
        if count:
            say(f"{count} positions are not measured, failed or disabled and are {fate}")
    if "licence" not in made.publication:
        say("no licence is stated: give one in [publication] of a TOML file, and name it with --publication")
    if as_json:
        print(json.dumps({key: value for key, value in asdict(made).items() if key not in _NOT_IN_JSON}, default=str))
        return
    content = f"{made.positions} positions, {made.actuators} actuators, {made.taps} taps, {made.response_unit}"
    say(f"{made.out}: {content}")
