"""The person at the bench, at a terminal or behind another program that speaks JSON lines."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict

from acquisition.calibrate.operator import (
    BOTH,
    SUM,
    VIBROMETER,
    By,
    Drop,
    Here,
    Jog,
    JogView,
    Judged,
    Keep,
    MapView,
    Redo,
    To,
)
from acquisition.manual.level import Level
from drivers.errors import InstrumentError
from storage.errors import InputError
from wavefocus.console import say
from wavefocus.json_lines import LinesIn
from wavefocus.rig.operation import Tell, tell_fault

HELP = 'two numbers move the beam by so many mrad, "= x y" moves it there, Enter alone says: the spot is on the mark'
CABLES = {
    VIBROMETER: "plug the vibrometer into the response input",
    SUM: "plug the summing box, with all outputs for actuators in it, into the response input",
    BOTH: "plug the loopback into both inputs, reference and response",
}


def cable(source: str) -> str:
    """What is to be plugged, in words."""
    return CABLES.get(source) or f"plug {source} of the player into the response input"


class TerminalOperator:
    """Implements `acquisition.calibrate.operator.Operator`."""

    def __init__(self, read_line: Callable[[], str], forget_typed: Callable[[], object] = lambda: None) -> None:
        self._read_line, self._forget_typed = read_line, forget_typed

    def tell(self, line: str) -> None:
        """Read a line."""
        say(line)

    def connect(self, source: str) -> None:
        """Plug something into the response input, and press Enter."""
        line = "?"
        while line:  # nothing but Enter says that it is done
            self._forget_typed()
            say(f"{cable(source)}, then press Enter")
            line = self._answer("a cable was plugged").strip()

    def jog(self, view: JogView) -> Jog:
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
                return Here()
            absolute = line.startswith("=")
            numbers = _two_numbers(line.removeprefix("="))
            if numbers is not None:
                return To(*numbers) if absolute else By(*numbers)
            say(f"{line!r} is not understood: {HELP}")

    def judge(self, view: MapView) -> Judged:
        """Take the map that was jogged; one that misses a mark is refused afterwards."""
        return Keep()

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
    """Two finite numbers with blanks or a comma between, None where there are no such."""
    try:
        first, second = (float(word) for word in text.replace(",", " ").split())
    except ValueError:
        return None
    return (first, second) if math.isfinite(first) and math.isfinite(second) else None


HEARS_EVERY_S = 0.25

Numbers = tuple[float, float]


class LinesOperator:
    """Implements `acquisition.calibrate.operator.Operator`."""

    def __init__(
        self,
        answers: LinesIn,
        tell: Tell,
        hear: Callable[[], Level],
        place_mm: Callable[[float, float], Numbers | None],
    ) -> None:
        self._answers, self._tell, self._hear, self._place_mm = answers, tell, hear, place_mm
        self._hears = True

    def tell(self, line: str) -> None:
        """Read a line."""
        self._tell("tell", line=line)

    def connect(self, source: str) -> None:
        """Plug something into the response input; ``{"answer": "done"}``."""
        self._tell("ask", what="connect", source=source, sentence=cable(source))
        while self._answer("a cable was plugged", {"done": ()})["answer"] != "done":
            pass

    def jog(self, view: JogView) -> Jog:
        """Say how the beam is to move: ``"by"`` or ``"to"`` with x_mrad and y_mrad, or ``"here"``."""
        self._tell(
            "ask",
            what="jog",
            number=view.number,
            of=view.of,
            place_mm=list(view.place_mm),
            at_mrad=list(view.at_mrad),
            at_mm=self._place_mm(*view.at_mrad),
            note=view.note,
        )
        angles = ("x_mrad", "y_mrad")
        words = {"here": (), "by": angles, "to": angles}
        answer = self._answer(f"mark {view.number} of {view.of} was met", words, hears=True)
        if answer["answer"] == "here":
            return Here()
        x_mrad, y_mrad = (float(answer[key]) for key in angles)  # type: ignore[arg-type]
        return By(x_mrad, y_mrad) if answer["answer"] == "by" else To(x_mrad, y_mrad)

    def judge(self, view: MapView) -> Judged:
        """Say what becomes of a map: ``"keep"``, ``"redo"`` with mark, or ``"drop"``."""
        facts = {key: None if isinstance(value, float) and math.isnan(value) else value
                 for key, value in asdict(view).items()}  # fmt: skip
        while True:
            self._tell("ask", what="map", **facts)
            answer = self._answer("the map was judged", {"keep": (), "redo": ("mark",), "drop": ()})
            match answer["answer"]:
                case "keep" if view.problem:
                    self._tell("refused", sentence=view.problem)
                case "keep":
                    return Keep()
                case "drop":
                    return Drop()
                case _:
                    mark = float(answer["mark"])  # type: ignore[arg-type]
                    if mark.is_integer() and 1 <= mark <= len(view.place_mm):
                        return Redo(int(mark))
                    self._tell("refused", sentence=f"mark {mark:g} is not there; allowed: 1 to {len(view.place_mm)}")

    def again(self, problem: str) -> bool:
        """Look for what is wrong; ``"again"`` tries once more, ``"skip"`` leaves it out."""
        self._tell("ask", what="again", problem=problem)
        return self._answer("this was decided", {"again": (), "skip": ()})["answer"] == "again"

    def _answer(
        self, before: str, words: Mapping[str, tuple[str, ...]], *, hears: bool = False
    ) -> Mapping[str, object]:
        """Wait for an answer that is one of some words, with the numbers that belong to it."""
        while True:
            try:
                content = self._answers.next(HEARS_EVERY_S if hears and self._hears else None)
            except TimeoutError:
                self._tell_level()
                continue
            except InputError as wrong:
                self._tell("refused", sentence=str(wrong))
                continue
            if content is None:
                raise InputError(f"standard input: ended before {before}")
            word = content.get("answer")
            if word == "cancel":
                raise KeyboardInterrupt
            if not isinstance(word, str) or word not in words:
                sentence = f"answer {word!r} is not understood; allowed: {', '.join((*words, 'cancel'))}"
            elif wrong_key := next((key for key in words[word] if not _is_number(content.get(key))), ""):
                sentence = f"{word}: {wrong_key} is {content.get(wrong_key)!r}; allowed: a finite number"
            else:
                return content
            self._tell("refused", sentence=sentence)

    def _tell_level(self) -> None:
        try:
            level = self._hear()
        except InstrumentError as failure:
            # The beam can be jogged by eye alone; what needs the inputs will say so in its turn.
            self._hears = False
            tell_fault(self._tell, failure)
            return
        self._tell("level", **asdict(level), light=None)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def forget_typed() -> None:
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
