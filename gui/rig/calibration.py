"""A calibration that the window asks a person through: what ``wavefocus calibrate`` asks, and what it found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from gui.rig.facts import ChannelLevel, maybe
from gui.rig.lines_process import LinesProcess, Told
from gui.shell.tab import TabContext

Pair = tuple[float, float]

_STOPPED = 130


@dataclass(frozen=True, slots=True)
class Ask:
    """A question to the person.

    Parameters
    ----------
    what : str
        ``"jog"``, ``"map"``, ``"connect"`` or ``"again"``.
    told : mapping
        Its facts.
    """

    what: str
    told: Told

    def pair(self, key: str) -> Pair | None:
        """Two numbers."""
        value = self.told.get(key)
        return (float(value[0]), float(value[1])) if isinstance(value, list) and len(value) == 2 else None

    def pairs(self, key: str) -> list[Pair]:
        """Many pairs of numbers."""
        value = self.told.get(key)
        return [(float(x), float(y)) for x, y in value] if isinstance(value, list) else []

    def figure(self, key: str) -> float | None:
        """A number, where there is one."""
        return maybe(self.told.get(key))

    def words(self, key: str) -> str:
        """A text."""
        return str(self.told.get(key) or "")


class Calibration:
    """At most one calibration under way.

    Parameters
    ----------
    context : TabContext
        Starts commands, tells sentences.

    Attributes
    ----------
    ask : Ask or None
        What the person is asked now; None while it works.
    lines : list of str
        What was told.
    marks : list of (float, float)
        Where the marks of the mirror map lie.
    outcome : dict or None
        What came of it, at the end.
    ending : str
        The sentence that it ended with; empty while it runs.
    reference, response : ChannelLevel or None
        What is heard while the beam is jogged.
    revision : dict
        Counts changes of ``"ask"`` and ``"level"``.
    """

    def __init__(self, context: TabContext) -> None:
        self._context = context
        self._process: LinesProcess | None = None
        self.revision = {"ask": 0, "level": 0}
        self._forget()

    def _forget(self) -> None:
        self._steps: Pair = (0.0, 0.0)
        self._moving = False
        self._unanswered = 0  # answers sent, less questions heard
        self.marks: list[Pair] = []
        self.ask: Ask | None = None
        self.lines: list[str] = []
        self.outcome: Told | None = None
        self.ending = ""
        self.reference: ChannelLevel | None = None
        self.response: ChannelLevel | None = None

    @property
    def running(self) -> bool:
        """Whether it holds the instruments."""
        return self._process is not None

    def start(self, rig: Path, options: Sequence[str]) -> None:
        """Start one."""
        if self._process is not None:
            return
        self._forget()
        arguments = ["calibrate", str(rig), "--operator", "lines", *options]
        self._process = LinesProcess.started(self._context, arguments, "the calibration cannot be started")
        self._changed("ask")

    def answer(self, word: str, **numbers: float) -> None:
        """Answer what is asked."""
        if self._process is not None and self.ask is not None:
            self._send_steps()
            self.ask = None
            self._changed("ask")
            self._send(word, **numbers)

    def step(self, x_mrad: float, y_mrad: float) -> None:
        """Move the beam by so much; steps that come while it moves are added up."""
        if self._process is None or self.ask is None or self.ask.what != "jog":
            return
        self._steps = self._steps[0] + x_mrad, self._steps[1] + y_mrad
        if not self._moving:
            self._send_steps()

    def cancel(self) -> None:
        """Leave it: outputs muted, mirror parked, what was measured until then written."""
        if self._process is not None:
            if self.ask is not None:
                self.answer("cancel")
            else:
                self._process.interrupt()

    def poll(self, then: Callable[[], object]) -> None:
        """Take up what came in; `then` is called when it is over."""
        process = self._process
        if process is not None and process.hand_over(self._hear):
            self._process = None
            self.ask = None
            cancelled = process.exit_code == _STOPPED
            self.ending = "cancelled; the outputs are muted, the mirror is parked" if cancelled else process.ending()
            self._changed("ask")
            if self.ending and not cancelled and self.outcome is None:
                self._context.messages.fault(self.ending)
            then()

    def let_go(self) -> None:
        """The window closes: it mutes, parks and ends by itself."""
        if self._process is not None:
            self._process.let_go()
            self._process = None

    def _hear(self, told: Told) -> None:
        match told.get("event"):
            case "begin":
                self.marks = Ask("begin", told).pairs("marks_mm")
            case "ask":
                self._hear_ask(Ask(str(told.get("what")), told))
            case "tell":
                self.lines.append(str(told.get("line")))
                self._changed("ask")
            case "level":
                reference, response = told.get("reference"), told.get("response")
                if isinstance(reference, dict) and isinstance(response, dict):
                    self.reference, self.response = ChannelLevel.told(reference), ChannelLevel.told(response)
                    self._changed("level")
            case "refused":
                self._context.messages.warn(str(told.get("sentence")))
            case "fault":
                self._context.messages.fault(str(told.get("sentence")))
            case "done":
                self.outcome = told
                self._changed("ask")

    def _hear_ask(self, ask: Ask) -> None:
        self._unanswered -= 1
        self._moving = self._unanswered >= 0
        if self._moving:
            return  # an answer to it is on its way already
        self.ask = ask
        self._changed("ask")
        if ask.what == "jog":
            self._send_steps()

    def _send_steps(self) -> None:
        (x_mrad, y_mrad), self._steps = self._steps, (0.0, 0.0)
        if x_mrad or y_mrad:
            self._moving = True
            self._send("by", x_mrad=round(x_mrad, 6), y_mrad=round(y_mrad, 6))

    def _send(self, word: str, **numbers: float) -> None:
        if self._process is not None:
            self._unanswered += 1
            self._process.send(answer=word, **numbers)

    def _changed(self, name: str) -> None:
        self.revision[name] += 1
