"""The person at the bench, at a terminal or behind another program that speaks JSON lines."""

import math
import sys
from collections.abc import Callable

from wavefocus.acquisition.calibrate_mirror import BOTH, SUM, VIBROMETER, Jog, JogView, Judged
from wavefocus.config.messages import Message, MessageError, Refused, message_of, tag
from wavefocus.config.messages.operate import InputLevels, Numbers
from wavefocus.config.messages.rig_checks import (
    Again,
    AskAgain,
    AskConnect,
    AskJog,
    By,
    Cancel,
    Drop,
    Here,
    Keep,
    MapView,
    Plugged,
    Redo,
    Skip,
    Tell,
    To,
)
from wavefocus.console import say
from wavefocus.drivers.errors import InstrumentError
from wavefocus.exits import one_line
from wavefocus.json_lines import LinesIn
from wavefocus.rig.operation import Publish, faulted, level_measured
from wavefocus.storage.errors import InputError

HELP = 'two numbers move the beam by so many mrad, "= x y" moves it there, Enter alone says: the spot is on the mark'
_CABLES = {
    VIBROMETER: "plug the vibrometer into the response input",
    SUM: "plug the summing box, with all outputs for actuators in it, into the response input",
    BOTH: "plug the loopback into both inputs, reference and response",
}


def cable(source: str) -> str:
    """What is to be plugged, in words."""
    return _CABLES.get(source) or f"plug {source} of the player into the response input"


class TerminalOperator:
    """Implements `wavefocus.acquisition.calibrate_mirror.Operator`."""

    def __init__(self, read_line: Callable[[], str], forget_typed: Callable[[], object] = lambda: None) -> None:
        self._read_line, self._forget_typed = read_line, forget_typed

    def report(self, line: str) -> None:
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
    try:
        first, second = (float(word) for word in text.replace(",", " ").split())
    except ValueError:
        return None
    return (first, second) if math.isfinite(first) and math.isfinite(second) else None


class LinesOperator:
    """A `wavefocus.acquisition.calibrate_mirror.Operator` that asks another program, by the messages of `calibrate`."""

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

    def connect(self, source: str) -> None:
        """Plug something into the response input."""
        self._publish(AskConnect(source, cable(source)))
        self._answer("a cable was plugged", Plugged)

    def jog(self, view: JogView) -> Jog:
        """Say how the beam is to move."""
        at_mm = self._place_mm(*view.at_mrad)
        self._publish(AskJog(view.number, view.of, view.place_mm, view.at_mrad, at_mm, view.note))
        step = self._answer(f"mark {view.number} of {view.of} was met", Here, By, To, listens=True)
        assert isinstance(step, Here | By | To)
        return step

    def judge(self, view: MapView) -> Judged:
        """Say what becomes of a map."""
        while True:
            self._publish(view)
            judged = self._answer("the map was judged", Keep, Redo, Drop)
            match judged:
                case Keep() if view.problem:
                    self._publish(Refused(view.problem))
                case Redo(mark) if not 1 <= mark <= len(view.place_mm):
                    self._publish(Refused(f"mark {mark} is not there; allowed: 1 to {len(view.place_mm)}"))
                case Keep() | Redo() | Drop():
                    return judged

    def again(self, problem: str) -> bool:
        """Look for what is wrong, and try once more or leave it out."""
        self._publish(AskAgain(problem))
        return isinstance(self._answer("this was decided", Again, Skip), Again)

    def _answer(self, before: str, *kinds: type[Message], listens: bool = False) -> Message:
        """Wait for an answer of one of some kinds; meanwhile report levels if `listens`."""
        while True:
            try:
                content = self._answers.next(0.25 if listens and self._listens else None)
                if content is None:
                    raise _EndedError(f"standard input: ended before {before}")
                word = content.get("answer")
                if word == tag(Cancel):
                    raise KeyboardInterrupt
                answer = message_of(content, kinds)
                if answer is None:
                    allowed = ", ".join([*(tag(kind) for kind in kinds), tag(Cancel)])
                    raise MessageError(f"answer {word!r} is not understood; allowed: {allowed}")
                return answer
            except TimeoutError:
                self._publish_level()
            except _EndedError:
                raise
            except (InputError, MessageError) as wrong:
                self._publish(Refused(one_line(str(wrong), 300)))

    def _publish_level(self) -> None:
        try:
            self._publish(level_measured(self._measure()))
        except InstrumentError as failure:
            # The beam can be jogged by eye alone; a step that needs the inputs fails by itself.
            self._listens = False
            self._publish(faulted(failure))


class _EndedError(InputError):
    """Standard input has ended before a question was answered."""


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
