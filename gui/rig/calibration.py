"""A calibration under way: questions of ``wavefocus calibrate``, answers, and its result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from config.messages.calibrate import (
    CALIBRATE_EVENTS,
    AskAgain,
    AskConnect,
    AskJog,
    Begin,
    CalibrationDone,
    MapView,
    Question,
    Tell,
)
from config.messages.codec import message_of
from config.messages.operate import Faulted, LevelMeasured, Refused
from gui.rig.manual_session import LASER_ADVICE
from gui.rig.messages import Pair
from gui.shell.process import STOPPED_BY_USER, CommandProcess, Message
from gui.shell.tab import TabContext


class Calibration:
    """At most one calibration.

    Attributes
    ----------
    question : Question or None
        What it asks now; None while it measures.
    lines : list of str
        Its report so far.
    marks_mm : list of (float, float)
        Marks of the mirror map.
    outcome : CalibrationDone or None
        Its result, at the end.
    ending : str
        Why it ended without a result; empty while it runs.
    levels : LevelMeasured or None
        Levels of the inputs while the beam is jogged.
    revision : dict
        Counts changes of ``"question"`` and ``"level"``.
    """

    def __init__(self, context: TabContext) -> None:
        self._context = context
        self._process: CommandProcess | None = None
        self.revision = {"question": 0, "level": 0}
        self._reset()

    def _reset(self) -> None:
        self._steps_mrad: Pair = (0.0, 0.0)
        self._moving = False
        self._unanswered = 0  # answers sent, less questions received
        self.marks_mm: list[Pair] = []
        self.question: Question | None = None
        self.lines: list[str] = []
        self.outcome: CalibrationDone | None = None
        self.ending = ""
        self.levels: LevelMeasured | None = None

    @property
    def running(self) -> bool:
        return self._process is not None

    def start(self, rig: Path, options: Sequence[str]) -> None:
        if self._process is None:
            self._reset()
            arguments = ["calibrate", str(rig), "--operator", "lines", *options]
            self._process = self._context.run(arguments, self._ended, self._receive, advice=LASER_ADVICE)
            self._changed("question")

    def answer(self, word: str, **numbers: float) -> None:
        if self._process is not None and self.question is not None:
            self._send_steps()
            self.question = None
            self._changed("question")
            self._send(word, **numbers)

    def step(self, x_mrad: float, y_mrad: float) -> None:
        """Move the beam; steps asked for while it moves are added up."""
        if self._process is None or self.question is None or not isinstance(self.question, AskJog):
            return
        self._steps_mrad = self._steps_mrad[0] + x_mrad, self._steps_mrad[1] + y_mrad
        if not self._moving:
            self._send_steps()

    def cancel(self) -> None:
        """End it: outputs muted, mirror parked, results so far written."""
        if self._process is not None:
            if self.question is not None:
                self.answer("cancel")
            else:
                self._process.interrupt()

    def detach(self) -> None:
        """Let the process mute, park and exit by itself; the window closes."""
        if self._process is not None:
            self._process.detach()
            self._process = None

    def _receive(self, message: Message) -> None:
        match message_of(message, CALIBRATE_EVENTS):
            case Begin(marks_mm=marks_mm):
                self.marks_mm = list(marks_mm)
            case AskConnect() | AskJog() | MapView() | AskAgain() as question:
                self._ask(question)
            case Tell(line=line):
                self.lines.append(line)
                self._changed("question")
            case LevelMeasured() as levels:
                self.levels = levels
                self._changed("level")
            case Refused(sentence=sentence):
                self._context.messages.warn(sentence)
            case Faulted(sentence=sentence):
                self._context.messages.fault(sentence)
            case CalibrationDone() as done:
                self.outcome = done
                self._changed("question")

    def _ask(self, question: Question) -> None:
        self._unanswered -= 1
        self._moving = self._unanswered >= 0
        if self._moving:
            return  # it is being answered already
        self.question = question
        self._changed("question")
        if isinstance(question, AskJog):
            self._send_steps()

    def _send_steps(self) -> None:
        (x_mrad, y_mrad), self._steps_mrad = self._steps_mrad, (0.0, 0.0)
        if x_mrad or y_mrad:
            self._moving = True
            self._send("by", x_mrad=round(x_mrad, 6), y_mrad=round(y_mrad, 6))

    def _send(self, word: str, **numbers: float) -> None:
        if self._process is not None:
            self._unanswered += 1
            self._process.send(answer=word, **numbers)

    def _ended(self, process: CommandProcess) -> None:
        self._process, self.question = None, None
        cancelled = process.exit_code == STOPPED_BY_USER
        self.ending = "cancelled; the outputs are muted, the mirror is parked" if cancelled else process.failure
        self._changed("question")
        messages = self._context.messages
        if self.outcome is not None and self.outcome.file:
            messages.note(f"written: {self.outcome.file}")
        elif self.ending and not cancelled and self.outcome is None:
            messages.fault(self.ending)

    def _changed(self, name: str) -> None:
        self.revision[name] += 1
