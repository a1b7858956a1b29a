"""``wavefocus import``: banks measured elsewhere."""

import json
from pathlib import Path

from wavefocus.calibration.imports import bank as imports
from wavefocus.console import answer, progress, say
from wavefocus.options import ImportOptions


def import_bank(
    source: Path, bank: Path, kind: str, *, options: ImportOptions, force: bool = False, as_json: bool
) -> None:
    """Make a bank of a file of another format, and print its report.

    Raises InputError: the file cannot be read or lacks a fact that an option can give, or the bank may not be written.
    """
    with progress("import", 1) as report:
        made = imports.import_bank(source, bank, options, kind, report, force=force)
    positions, actuators, taps = made.shape
    say(f"{bank}: {made.measured} of {positions} positions, {actuators} actuators, {taps} taps")
    for warning in filter(None, (*made.facts["warnings"], made.facts["caution"])):
        say(f"warning: {warning}")
    if as_json:
        figures = {"bank": str(bank), "positions": positions, "measured": made.measured, "actuators": actuators,
                   "taps": taps, **made.facts}  # fmt: skip
        print(json.dumps(figures))
        return
    answer(made.facts["paragraph"])
