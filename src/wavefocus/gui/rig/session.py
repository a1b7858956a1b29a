"""Child processes that hold a rig's instruments: ``wavefocus operate`` and ``wavefocus calibrate``."""

from collections.abc import Callable, Sequence
from pathlib import Path

from PyQt5.QtCore import pyqtSignal

from wavefocus.config.messages import Refused, message_of, operate, rig_checks
from wavefocus.gui.process import CommandProcess, Message
from wavefocus.gui.tab import OwnCommand, TabContext

_LASER_ADVICE = "the laser may stand where it was: park it, or switch it off"


class ManualSession(OwnCommand):
    """A rig that is operated by hand.

    state: ``"released"``, ``"opening"``, ``"ready"`` or ``"ending"``.
    facts: The rig, once it is open.
    beam: Place of the beam.
    levels: Latest levels of the inputs.
    listening, sweeping: Whether levels arrive; whether a sweep is under way.
    sweep, swept_off: The last one, and why the beam was not on the surface when it was asked for.
    """

    changed = pyqtSignal()

    def __init__(self, context: TabContext) -> None:
        super().__init__(context)
        self._reset()

    def _reset(self) -> None:
        self.state = "released"
        self._then: Callable[[], object] | None = None
        self.facts: operate.Ready | None = None
        self.beam = operate.MirrorMoved()
        self.levels: operate.LevelMeasured | None = None
        self.listening = self.sweeping = False
        self.sweep: operate.SweepTaken | None = None
        self.swept_off = ""
        self._moving_to: operate.Numbers | None = None
        self._next: operate.Numbers | None = None

    @property
    def place_mm(self) -> operate.Numbers | None:
        """Place of the beam on the surface; None where it is parked or off the surface."""
        x_mm, y_mm = self.beam.x_mm, self.beam.y_mm
        return None if self.beam.parked or x_mm is None or y_mm is None else (x_mm, y_mm)

    @property
    def _off_surface(self) -> str:
        """Why the beam is not on the surface, in a sentence; empty where it is."""
        beam = self.beam
        if beam.parked:
            return "the beam is parked: what is recorded is not of the surface"
        if beam.x_mrad is None or beam.y_mrad is None:
            return "the beam was not moved since the instruments were opened: it may not be on the surface"
        return "" if self.place_mm is not None else "the beam is outside the surface"

    def take(self, rig: Path, holds: str = "") -> None:
        """Open the instruments; `holds` as of `OwnCommand.run`."""
        if self.own is None:
            self._reset()
            self.run(["operate", str(rig)], self._ended, self._receive, holds=holds, advice=_LASER_ADVICE)
            self._enter("opening")

    def release(self, then: Callable[[], object] | None = None) -> None:
        """Mute, park and close the instruments; `then` is called when they are free."""
        if self.own is None:
            if then is not None:
                then()
            return
        self._then = then
        self.own.send(order="mute")
        self.own.close_input()
        self._enter("ending")

    def jog_to(self, x_mm: float, y_mm: float) -> None:
        """Send the beam to a place; of places asked for while it moves, only the last counts."""
        if self.state != "ready":
            return
        if self._moving_to is not None:
            self._next = x_mm, y_mm
            return
        self._moving_to = x_mm, y_mm
        self._order(order="jog", x_mm=x_mm, y_mm=y_mm)

    def jog_by(self, x_mm: float, y_mm: float) -> None:
        """Move the beam relative to where it is, or is going."""
        from_mm = self._next or self._moving_to or self.place_mm or (0.0, 0.0)
        self.jog_to(round(from_mm[0] + x_mm, 4), round(from_mm[1] + y_mm, 4))

    def park(self) -> None:
        """Send the beam to its safe direction."""
        self._next = None
        self._order(order="park")

    def mute(self) -> None:
        """Silence the outputs at once and drop waiting orders."""
        self._next = None
        self._order(order="mute")

    def listen(self, on: bool, actuator: int | None, level_v: float) -> None:
        """Switch level messages on or off; `actuator` plays short sweeps meanwhile, None for silence."""
        sounding = {} if actuator is None else {"actuator": actuator, "level_v": level_v}
        self._order(order="level", on=on, **sounding)

    def take_sweep(self, actuator: int, level_v: float, start_hz: float, stop_hz: float, duration_s: float) -> None:
        self.sweeping = True
        self.swept_off = self._off_surface
        self._order(
            order="sweep", actuator=actuator, level_v=level_v, start_hz=start_hz, stop_hz=stop_hz, duration_s=duration_s
        )

    def detach(self) -> None:
        if self.own is not None:
            self.own.send(order="mute")
        super().detach()

    def _order(self, **order: object) -> None:
        if self.own is not None and self.state == "ready":
            self.own.send(**order)

    def _receive(self, message: Message) -> None:
        match message_of(message, operate.OPERATE_EVENTS):
            case operate.Ready() as facts:
                self.facts, self.state = facts, "ready"
            case operate.MirrorMoved() as beam:
                self.beam = beam
            case operate.LevelsSwitched(on=on):
                self.listening = on
            case operate.LevelMeasured() as levels:
                self.levels, self.listening = levels, True
            case operate.SweepTaken() as sweep:
                self.sweep = sweep
            case operate.Done() as done:
                self._order_done(done)
            case Refused(sentence=sentence):
                self._context.messages.warn(sentence)
            case operate.Faulted() as fault:
                self._report_fault(fault)
        self.changed.emit()

    def _report_fault(self, fault: operate.Faulted) -> None:
        role = fault.instrument
        answers = []
        if self.state == "ready" and role in ("mirror", "recorder", "player"):
            answers = [(f"Reconnect the {role}", lambda: self._order(order="reconnect", instrument=role))]
        self._context.messages.fault(fault.sentence, *answers)
        if not fault.passing:
            self.listening = False

    def _order_done(self, done: operate.Done) -> None:
        match done.order:
            case "jog":
                self._moving_to, wanted, self._next = None, self._next, None
                if wanted is not None:
                    self.jog_to(*wanted)
            case "sweep":
                self.sweeping = False
            case "mute":  # waiting orders were dropped without an answer
                self._moving_to, self.sweeping = None, False
            case "reconnect" if done.ok:
                self._context.messages.note("reconnected")

    def _ended(self, process: CommandProcess) -> None:
        expected, then = self.state == "ending", self._then
        self._reset()
        self.changed.emit()
        self._context.report_end(process)
        if process.failure:
            return
        if not expected:
            self._context.messages.warn("wavefocus operate has ended; the outputs are muted, the mirror is parked")
        if then is not None:
            then()

    def _enter(self, state: str) -> None:
        self.state = state
        self.changed.emit()


class Calibration(OwnCommand):
    """A calibration.

    levels: Latest levels of the inputs.
    question: What it asks now; None while it measures.
    lines: Its report so far.
    marks_mm: Marks of the mirror map; before it begins, those of the surface.
    outcome: Its result, at the end.
    ending: How it ended without a result; empty while it runs.
    """

    level_changed = pyqtSignal()
    changed = pyqtSignal()

    def __init__(self, context: TabContext) -> None:
        super().__init__(context)
        self.marks_mm: list[operate.Numbers] = []
        self._reset()

    def _reset(self) -> None:
        self._steps_mrad: operate.Numbers = (0.0, 0.0)
        self._moving = False
        self._unanswered = 0  # answers sent, less questions received
        self.question: rig_checks.OperatorQuestion | None = None
        self.lines: list[str] = []
        self.outcome: rig_checks.CalibrationDone | None = None
        self.ending = ""
        self.levels: operate.LevelMeasured | None = None

    def start(self, rig: Path, options: Sequence[str], holds: str = "") -> None:
        """Calibrate; `holds` as of `OwnCommand.run`."""
        if self.own is None:
            self._reset()
            arguments = ["calibrate", str(rig), "--operator", "lines", *options]
            self.run(arguments, self._ended, self._receive, holds=holds, advice=_LASER_ADVICE)
            self.changed.emit()

    def answer(self, word: str, **numbers: float) -> None:
        if self.own is not None and self.question is not None:
            self._send_steps()
            self.question = None
            self.changed.emit()
            self._send(word, **numbers)

    def step(self, x_mrad: float, y_mrad: float) -> None:
        """Move the beam; steps asked for while it moves are added up."""
        if isinstance(self.question, rig_checks.AskJog):
            self._steps_mrad = self._steps_mrad[0] + x_mrad, self._steps_mrad[1] + y_mrad
            if not self._moving:
                self._send_steps()

    def cancel(self) -> None:
        """End it: outputs muted, mirror parked, results so far written."""
        if self.question is not None:
            self.answer("cancel")
        else:
            self.interrupt()

    def _receive(self, message: Message) -> None:
        match message_of(message, rig_checks.CALIBRATE_EVENTS):
            case rig_checks.Begin(marks_mm=marks_mm):
                self.marks_mm = list(marks_mm)
            case (
                rig_checks.AskConnect() | rig_checks.AskJog() | rig_checks.MapView() | rig_checks.AskAgain() as question
            ):
                self._ask(question)
            case rig_checks.Tell(line=line):
                self.lines.append(line)
                self.changed.emit()
            case operate.LevelMeasured() as levels:
                self.levels = levels
                self.level_changed.emit()
            case Refused(sentence=sentence):
                self._context.messages.warn(sentence)
            case operate.Faulted(sentence=sentence):
                self._context.messages.fault(sentence)
            case rig_checks.CalibrationDone() as done:
                self.outcome = done
                self.changed.emit()

    def _ask(self, question: rig_checks.OperatorQuestion) -> None:
        self._unanswered -= 1
        self._moving = self._unanswered >= 0
        if self._moving:
            return  # it is being answered already
        self.question = question
        self.changed.emit()
        if isinstance(question, rig_checks.AskJog):
            self._send_steps()

    def _send_steps(self) -> None:
        (x_mrad, y_mrad), self._steps_mrad = self._steps_mrad, (0.0, 0.0)
        if x_mrad or y_mrad:
            self._moving = True
            self._send("by", x_mrad=round(x_mrad, 6), y_mrad=round(y_mrad, 6))

    def _send(self, word: str, **numbers: float) -> None:
        if self.own is not None:
            self._unanswered += 1
            self.own.send(answer=word, **numbers)

    def _ended(self, process: CommandProcess) -> None:
        self.question = None
        if self.outcome is None:
            cancelled = "cancelled; the outputs are muted, the mirror is parked"
            self.ending = self._context.report_end(process, stopped=cancelled)
        self.changed.emit()
