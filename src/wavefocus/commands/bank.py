"""``wavefocus check``, ``estimate``, ``export``, ``import`` and ``note``: banks that are checked, made and described.

Each function imports what it needs when it runs: a note does not wait for what estimates.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from wavefocus.console import Exit, answer, progress, say, spinner
from wavefocus.options import ExportOptions, ImportOptions

# So many lines of a kind are read; the rest is for programs.
_MAX_LINES = 10


def check(file: Path, *, as_json: bool) -> Exit:
    """Report everything that is wrong with a file; errors make the exit code 1, warnings do not."""
    from wavefocus.calibration.check import check_file

    with spinner("verifying every row, and comparing it with its neighbours"):
        findings = check_file(file)
    found = {
        level: [one.message for one in findings if one.severity == level] for level in ("error", "warning", "note")
    }
    errors = len(found["error"])
    if as_json:
        _print({"bank": str(file), "errors": errors, "findings": [asdict(one) for one in findings]})
    line = say if as_json else answer
    for severity, messages in found.items():
        for message in messages[:_MAX_LINES]:
            line(f"{severity}: {message}")
        if len(messages) > _MAX_LINES:
            line(f"{severity}: and {len(messages) - _MAX_LINES} more; --json lists all")
    line(f"{file}: {errors} errors, {len(found['warning'])} warnings")
    return Exit.NOT_GOOD_ENOUGH if errors else Exit.DONE


def estimate(raw: Path, bank: Path, *, cluster: str = "", as_json: bool) -> None:
    """Estimate all positions of a raw file that the bank does not hold yet; a new bank is made where none is."""
    from wavefocus.acquisition.wording import hours
    from wavefocus.estimation import estimate_into
    from wavefocus.storage.bank.ledger import status_counts
    from wavefocus.storage.raw.writer import open_raw

    with open_raw(raw) as recordings:
        header = recordings.header
        done = estimate_into(recordings, bank, None, cluster=cluster, report=say, watch=progress)
    for fault in done.faults[:_MAX_LINES]:
        say(fault)
    if len(done.faults) > _MAX_LINES:
        say(f"and {len(done.faults) - _MAX_LINES} positions more that are not valid")
    counts, signals = status_counts(done.status), done.positions * header.actuators
    per_s = signals / done.took_s if done.took_s > 0 else 0.0
    if as_json:
        facts = {"bank": str(bank), "raw": str(raw), "positions": header.positions, "estimated": done.positions}
        speed = {"seconds": round(done.took_s, 3), "green_functions_per_s": round(per_s, 1) or None}
        _print({**facts, "counts": counts, **speed})
    words = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    made = f"; {signals} Green's functions in {hours(done.took_s)}, {per_s:.0f} a second" if signals else ""
    say(f"{bank}: {header.positions} positions ({words}){made}")


def export(
    bank: Path, out: Path, to: str, *, positions: str, options: ExportOptions, force: bool, as_json: bool
) -> None:
    """Write a bank, or some rows of it, in another format.

    Raises InputError: the bank cannot be read or does not fit the format, or a file to be written must stay.
    """
    from wavefocus.banks import export_by_options
    from wavefocus.input_files import parse_positions
    from wavefocus.storage.bank.reading import open_bank

    with open_bank(bank) as view, progress("export", 1) as report:
        wanted: Sequence[int] | None = parse_positions(positions, view.positions) if positions else None
        made = export_by_options(view, out, to, options, wanted, report, force=force)
    for count, fate in ((made.left_out, "left out"), (made.nan, "NaN")):
        if count:
            say(f"{count} positions are not measured, failed or disabled and are {fate}")
    if "licence" not in made.publication:
        say("no licence is stated: give one in [publication] of a TOML file, and name it with --publication")
    if as_json:
        keys = ("out", "format", "positions", "left_out", "nan", "actuators", "taps")
        _print({key: getattr(made, key) for key in keys})
        return
    say(f"{out}: {made.positions} positions, {made.actuators} actuators, {made.taps} taps, {made.response_unit}")


def import_bank(
    source: Path, bank: Path, kind: str, *, options: ImportOptions, force: bool = False, as_json: bool
) -> None:
    """Make a bank of a file of another format, and print its report.

    Raises InputError: the file cannot be read or lacks a fact that an option can give, or the bank may not be written.
    """
    from wavefocus.calibration.imports import bank as imports

    with progress("import", 1) as report:
        facts, figures = imports.import_bank(source, bank, options, kind, report, force=force)
    say("{}: {measured} of {positions} positions, {actuators} actuators, {taps} taps".format(bank, **figures))
    for warning in filter(None, (*facts["warnings"], facts["caution"])):
        say(f"warning: {warning}")
    if as_json:
        _print({"bank": str(bank), **figures, **facts})
    else:
        answer(facts["paragraph"])


def note(bank: Path, text: str, *, as_json: bool) -> None:
    """Add a note with the time of now; InputError where it cannot be."""
    from wavefocus.storage.bank.notes import add_note

    added = add_note(bank, text)
    say(f"{bank}: noted at {added.at}")
    if as_json:
        _print({"bank": str(bank), **asdict(added)})


def _print(facts: dict[str, Any]) -> None:
    print(json.dumps(facts, default=str))
