"""``wavefocus calibrate``: measure what a rig file can only believe, into a calibration file."""

import json
import os
import sys
from contextlib import suppress
from datetime import date
from pathlib import Path

from wavefocus.acquisition.calibrate_mirror import Operator
from wavefocus.acquisition.manual import ManualMeasurements
from wavefocus.acquisition.setup import Setup
from wavefocus.config.calibration import CalibrationRecord, name_calibration, write_calibration
from wavefocus.config.messages import to_record
from wavefocus.config.messages.rig_checks import Begin, CalibrationDone
from wavefocus.configuration import load_rig
from wavefocus.console import say
from wavefocus.drivers.errors import InstrumentError
from wavefocus.ending import ending_at_once
from wavefocus.exits import Exit
from wavefocus.json_lines import LinesIn, LinesOut
from wavefocus.options import CalibrationOptions
from wavefocus.rig.calibration_session import CalibrationSession, marks
from wavefocus.rig.instruments import openers_of
from wavefocus.rig.operation import SAMPLE_RATE_HZ, faulted
from wavefocus.rig.operators import LinesOperator, TerminalOperator, forget_typed
from wavefocus.rig.setup import open_rig, setup_in_use
from wavefocus.storage.errors import ExistsError, InputError


def calibrate(
    rig_file: Path, options: CalibrationOptions, out: Path | None, *, as_json: bool, operator: str, use: bool
) -> Exit:
    """Calibrate a rig with the person at this terminal; exit code 1 when something is not good enough.

    With the operator ``lines`` the person sits before another program, which is asked by JSON lines; with `use` the
    rig file is made to name what was written.
    """
    rig = load_rig(rig_file)
    if out is not None and os.path.lexists(out):
        raise InputError(f"--out {out}: is there already and is not overwritten; name another file")
    file: Path | None = None
    session = CalibrationSession(rig, options)
    lines = LinesOut() if operator == "lines" else None
    if lines is not None:
        lines(Begin(options.parts, marks(rig, options)[0]))
    with ending_at_once():
        try:
            openers = openers_of(rig)
            with setup_in_use(open_rig(rig, openers), rig, SAMPLE_RATE_HZ) as setup:
                session.carry_out(setup, _operator(setup, lines), openers.connect)
        except InstrumentError as failure:
            if lines is not None:
                lines(faulted(failure))
            raise
        finally:
            # Whatever ends a calibration, the cables plugged so far were not plugged for nothing.
            record = session.record()
            if session.measured:
                file = _kept(out, record, rig_file.parent)
                _report(file, session.measured, rig_file, use=use)
    for problem in session.problems:
        say(f"not good enough: {problem}")
    if as_json or lines is not None:
        done = CalibrationDone(
            file=None if file is None else str(file),
            measured=tuple(session.measured),
            problems=tuple(session.problems),
            calibration=record.model_dump(mode="json"),
        )
        if lines is not None:
            lines(done)
        else:
            print(json.dumps({key: value for key, value in to_record(done).items() if key != "event"}))
    return Exit.NOT_GOOD_ENOUGH if session.problems else Exit.DONE


def _operator(setup: Setup, lines: LinesOut | None) -> Operator:
    if lines is None:
        return TerminalOperator(sys.stdin.readline, forget_typed)

    def place_mm(x_mrad: float, y_mrad: float) -> tuple[float, float] | None:
        try:
            x_mm, y_mm = setup.mirror_map.surface_mm(x_mrad, y_mrad)
        except InputError:  # a beam that never meets the surface
            return None
        return round(float(x_mm), 4), round(float(y_mm), 4)

    answers = LinesIn()
    answers.start()
    return LinesOperator(answers, lines, ManualMeasurements(setup, SAMPLE_RATE_HZ).level, place_mm)


def _kept(out: Path | None, record: CalibrationRecord, folder: Path) -> Path:
    """Write to the file asked for, or one of today's next to the rig file; where a name is taken, to the next one."""
    first = out or folder / f"calibration-{date.today().isoformat()}.toml"
    for file in (first, *(first.with_stem(f"{first.stem}-{number}") for number in range(2, 1000))):
        with suppress(ExistsError):
            write_calibration(file, record)
            return file
    raise ExistsError(f"{first}: this name and 998 like it are taken; move some of these files away")


def _report(file: Path, measured: list[str], rig_file: Path, *, use: bool) -> None:
    say(f"{file}: {', '.join(measured)}")
    name = _name_from(rig_file.parent, file)
    if not use:
        say(f'name it in {rig_file}: [calibration] file = "{name}"')
        return
    name_calibration(rig_file, name)
    say(f"{rig_file}: names {name} as its calibration")


def _name_from(folder: Path, file: Path) -> str:
    """A file as a rig file names it: from its folder, with slashes, which every system reads."""
    try:
        return Path(os.path.relpath(file, folder)).as_posix()
    except ValueError:  # on another drive
        return file.absolute().as_posix()
