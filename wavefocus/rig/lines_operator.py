"""A person behind another program: asked by JSON lines on standard output, answers by JSON lines on standard input."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict

from acquisition.by_hand.level import Level
from acquisition.calibration_procedures.operator import By, Drop, Here, Jog, JogView, Judged, Keep, MapView, Redo, To
from drivers.errors import InstrumentError
from storage.errors import InputError
from wavefocus.json_lines import LinesIn
from wavefocus.rig.operation import Tell, tell_fault
from wavefocus.rig.terminal_operator import cable

HEARS_EVERY_S = 0.25

Numbers = tuple[float, float]


class LinesOperator:
    """Implements `acquisition.calibration_procedures.operator.Operator`.

    Parameters
    ----------
    answers : LinesIn
        Where answers come from; ``{"answer": "cancel"}`` ends the calibration at any question.
    tell : callable
        Receives events: ``tell``, ``ask``, ``level`` while the beam is jogged, ``refused``.
    hear : callable
        Gives the level of both inputs.
    place_mm : callable
        Where on the surface the beam falls at some angles, by the map believed so far; None where nowhere.
    """

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
