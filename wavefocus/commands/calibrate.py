"""``wavefocus calibrate``: measure what a rig file can only believe, into a calibration file."""

from __future__ import annotations

import json
import sys
from datetime import date
from pathlib import Path

from acquisition.calibration_procedures.operator import Operator
from calibration.errors import InputError
from wavefocus.calibration_request import Request
from wavefocus.calibration_session import CalibrationSession
from wavefocus.compose import put_to_rest, setup_of
from wavefocus.config.calibration_file import PARTS
from wavefocus.config.calibration_toml import write_calibration
from wavefocus.config.loading import load_rig
from wavefocus.console import say
from wavefocus.exits import Exit
from wavefocus.instruments import open_rig, openers
from wavefocus.terminal_operator import TerminalOperator, VirtualHands


def calibrate(rig_file: Path, request: Request, out: Path | None, *, as_json: bool) -> Exit:
    """Calibrate a rig with the person at this terminal; exit code 1 when something is not good enough."""
    rig = load_rig(rig_file)
    file = _file(out, rig_file.parent)
    session = CalibrationSession(rig, request)
    opened = open_rig(openers(rig))
    setup = setup_of(rig, opened)
    terminal = TerminalOperator(sys.stdin.readline)
    operator: Operator = terminal if opened.patch_bay is None else VirtualHands(terminal, opened.patch_bay)
    try:
        with put_to_rest(setup):
            session.carry_out(setup, operator)
    finally:
        # Whatever ends a calibration, the cables plugged so far were not plugged for nothing.
        record = session.record()
        if session.measured:
            write_calibration(file, record)
            say(f"{file}: {', '.join(session.measured)}")
            say(f'name it in {rig_file}: [calibration] file = "{file.name}"')
    for problem in session.problems:
        say(f"not good enough: {problem}")
    if as_json:
        facts = {
            "file": str(file) if session.measured else None,
            "measured": session.measured,
            "problems": session.problems,
            "calibration": record.model_dump(mode="json"),
        }
        print(json.dumps(facts))
    return Exit.NOT_GOOD_ENOUGH if session.problems else Exit.DONE


def parts_named(words: str) -> tuple[str, ...]:
    """Parts from words with commas between; all where there are none.

    Raises
    ------
    InputError
        A word that is no part.
    """
    parts = tuple(word.strip() for word in words.split(",")) if words else PARTS
    for part in parts:
        if part not in PARTS:
            raise InputError(f"--only: {part!r} is not known; allowed: {', '.join(PARTS)}")
    return parts


def _file(out: Path | None, folder: Path) -> Path:
    """Where to write: the file asked for, or one of today's beside the rig file; none is overwritten."""
    if out is not None:
        if out.exists():
            raise InputError(f"--out {out}: is there already and is not overwritten; name another file")
        return out
    name = f"calibration-{date.today().isoformat()}"
    candidates = [folder / f"{name}.toml", *(folder / f"{name}-{number}.toml" for number in range(2, 1000))]
    return next(file for file in candidates if not file.exists())
