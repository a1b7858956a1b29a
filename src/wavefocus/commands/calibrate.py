"""``wavefocus calibrate``: a rig measured with a person at a terminal, or behind a program that speaks JSON lines."""

import json
import math
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from datetime import date
from pathlib import Path
from secrets import token_hex

from msgspec.structs import replace

from wavefocus.acquisition.calibrate_mirror import BOTH, SUM, VIBROMETER, Operator
from wavefocus.acquisition.manual import ManualMeasurements
from wavefocus.acquisition.setup import Setup
from wavefocus.config.calibration import CalibrationRecord, name_calibration, write_calibration
from wavefocus.config.messages import MessageError, Refused, from_record, to_record
from wavefocus.config.messages.operate import InputLevels, Numbers
from wavefocus.config.messages.rig_checks import (
    ANSWERS,
    CANCEL,
    Answer,
    AskAgain,
    AskConnect,
    AskJog,
    Begin,
    CalibrationDone,
    MapView,
    Tell,
)
from wavefocus.configuration import load_rig
from wavefocus.console import Exit, one_line, say
from wavefocus.drivers.errors import InstrumentError
from wavefocus.ending import ending_at_once
from wavefocus.json_lines import LinesIn, LinesOut
from wavefocus.options import CalibrationOptions
from wavefocus.rig.calibration_session import CalibrationSession, marks
from wavefocus.rig.instruments import openers_of
from wavefocus.rig.operation import SAMPLE_RATE_HZ, Publish, faulted, level_measured
from wavefocus.rig.setup import open_rig, setup_in_use
from wavefocus.storage.errors import ExistsError, InputError
from wavefocus.storage.sidecar_files import create

HELP = 'two numbers move the beam by so many mrad, "= x y" moves it there, Enter alone says: the spot is on the mark'
_CABLES = {
    VIBROMETER: "plug the vibrometer into the response input",
    SUM: "plug the summing box, with all outputs for actuators in it, into the response input",
    BOTH: "plug the loopback into both inputs, reference and response",
}


def cable(source: str) -> str:
    """What is to be plugged, in words."""
    return _CABLES.get(source) or f"plug {source} of the player into the response input"


class TerminalOperator(Operator):
    """A person at a terminal."""

    def __init__(self, read_line: Callable[[], str], forget_typed: Callable[[], object] = lambda: None) -> None:
        self._read_line, self._forget_typed = read_line, forget_typed

    def report(self, line: str) -> None:
        """Read a line."""
        say(line)

    def plug_in(self, source: str) -> None:
        """Plug something into the response input, and press Enter."""
        line = "?"
        while line:  # nothing but Enter says that it is done
            self._forget_typed()
            say(f"{cable(source)}, then press Enter")
            line = self._answer("a cable was plugged").strip()

    def jog(self, view: AskJog) -> Answer:
        """Read how the beam is to move; what is not understood is asked again."""
        if view.note:
            say(view.note)
        while True:
            self._forget_typed()
            (x_mm, y_mm), (x_mrad, y_mrad) = view.place_mm, view.at_mrad
            now = f"mirror at ({x_mrad:.3f}, {y_mrad:.3f}) mrad"
            say(f"mark {view.number} of {view.of} at ({x_mm:g}, {y_mm:g}) mm; {now}")
            say(f"  type: {HELP}")
            line = self._answer(f"mark {view.number} of {view.of} was met").strip()
            if not line:
                return Answer("here")
            absolute = line.startswith("=")
            numbers = _two_numbers(line.removeprefix("="))
            if numbers is not None:
                return Answer("to" if absolute else "by", *numbers)
            say(f"{line!r} is not understood: {HELP}")

    def judge(self, view: MapView) -> Answer:
        """Take the map that was jogged; one that misses a mark is refused afterwards."""
        return Answer("keep")

    def again(self, problem: str) -> bool:
        """Look for what is wrong; Enter tries once more, s leaves it out."""
        self._forget_typed()
        say(f"{problem}; press Enter to try once more, or s and Enter to leave it out")
        return self._answer("this was decided").strip().lower() not in ("s", "skip")

    def _answer(self, before: str) -> str:
        line = self._read_line()
        if not line:
            raise InputError(f"standard input: ended before {before}")
        return line


def _two_numbers(text: str) -> tuple[float, float] | None:
    try:
        first, second = (float(word) for word in text.replace(",", " ").split())
    except ValueError:
        return None
    return (first, second) if math.isfinite(first) and math.isfinite(second) else None


class _LinesOperator(Operator):
    """A person before another program, which is asked by the messages of `calibrate`."""

    def __init__(
        self,
        answers: LinesIn,
        publish: Publish,
        measure: Callable[[], InputLevels],
        place_mm: Callable[[float, float], Numbers | None],
    ) -> None:
        self._answers, self._publish, self._measure, self._place_mm = answers, publish, measure, place_mm
        self._listens = True

    def report(self, line: str) -> None:
        """Read a line."""
        self._publish(Tell(line))

    def plug_in(self, source: str) -> None:
        """Plug something into the response input."""
        self._publish(AskConnect(source, cable(source)))
        self._answer("a cable was plugged", "connect")

    def jog(self, view: AskJog) -> Answer:
        """Say how the beam is to move."""
        self._publish(replace(view, at_mm=self._place_mm(*view.at_mrad)))
        return self._answer(f"mark {view.number} of {view.of} was met", "jog", listens=True)

    def judge(self, view: MapView) -> Answer:
        """Say what becomes of a map."""
        while True:
            self._publish(view)
            judged = self._answer("the map was judged", "map")
            if judged.answer == "keep" and view.problem:
                self._publish(Refused(view.problem))
            elif judged.answer == "redo" and not 1 <= judged.mark <= len(view.place_mm):
                self._publish(Refused(f"mark {judged.mark} is not there; allowed: 1 to {len(view.place_mm)}"))
            else:
                return judged

    def again(self, problem: str) -> bool:
        """Look for what is wrong, and try once more or leave it out."""
        self._publish(AskAgain(problem))
        return self._answer("this was decided", "again").answer == "again"

    def _answer(self, before: str, question: str, *, listens: bool = False) -> Answer:
        """Wait for an answer to a kind of question; meanwhile report levels if `listens`."""
        allowed = ANSWERS[question]
        while True:
            try:
                content = self._answers.next(0.25 if listens and self._listens else None)
                if content is None:
                    break
                word = content.get("answer")
                if word == CANCEL:
                    raise KeyboardInterrupt
                if not isinstance(word, str) or word not in allowed:
                    raise MessageError(f"answer {word!r} is not understood; allowed: {', '.join([*allowed, CANCEL])}")
                if missing := [key for key in allowed[word] if key not in content]:
                    raise MessageError(f"answer {word!r} lacks {' and '.join(missing)}")
                return from_record(Answer, content)
            except TimeoutError:
                self._publish_level()
            except (InputError, MessageError) as wrong:
                self._publish(Refused(one_line(str(wrong), 300)))
        raise InputError(f"standard input: ended before {before}")

    def _publish_level(self) -> None:
        try:
            self._publish(level_measured(self._measure()))
        except InstrumentError as failure:
            # The beam can be jogged by eye alone; a step that needs the inputs fails by itself.
            self._listens = False
            self._publish(faulted(failure))


def _forget_typed() -> None:
    """Drop what was typed and not read yet; what comes through a pipe or from a file stays."""
    if sys.stdin is None or not sys.stdin.isatty():
        return
    if sys.platform == "win32":
        import msvcrt

        while msvcrt.kbhit():
            msvcrt.getwch()
    else:
        import termios

        termios.tcflush(sys.stdin, termios.TCIFLUSH)


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
    folder = (out or rig_file).parent
    try:
        tried = folder / f".calibration-{token_hex(8)}.new"
        create(tried).close()
        tried.unlink()
    except OSError as error:
        why = f"no calibration can be written there ({error.strerror or error})"
        raise InputError(f"{folder}: {why}; name a file elsewhere by --out") from None
    file: Path | None = None
    session = CalibrationSession(rig, options)
    lines = LinesOut() if operator == "lines" else None
    if lines is not None:
        lines(Begin(options.parts, marks(rig, options)[0]))
    with ending_at_once():
        try:
            openers = openers_of(rig)
            with setup_in_use(open_rig(openers), rig, SAMPLE_RATE_HZ) as setup:
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
        return TerminalOperator(sys.stdin.readline, _forget_typed)

    def place_mm(x_mrad: float, y_mrad: float) -> tuple[float, float] | None:
        try:
            x_mm, y_mm = setup.mirror_map.surface_mm(x_mrad, y_mrad)
        except InputError:  # a beam that never meets the surface
            return None
        return round(float(x_mm), 4), round(float(y_mm), 4)

    answers = LinesIn()
    answers.start()
    return _LinesOperator(answers, lines, ManualMeasurements(setup, SAMPLE_RATE_HZ).level, place_mm)


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
