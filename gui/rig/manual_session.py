"""A rig operated by hand: orders to ``wavefocus operate``, and its answers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from config.messages.codec import message_of
from config.messages.operate import (
    OPERATE_EVENTS,
    Done,
    Faulted,
    LevelMeasured,
    LevelsSwitched,
    MirrorMoved,
    Ready,
    Refused,
    SweepTaken,
)
from gui.rig.messages import Pair, Spot
from gui.shell.process import CommandProcess, Message
from gui.shell.tab import TabContext

LASER_ADVICE = "the laser may stand where it was: park it, or switch it off"


class ManualSession:
    """State of a rig that is operated by hand.

    Attributes
    ----------
    state : str
        ``"released"``, ``"opening"``, ``"ready"`` or ``"ending"``.
    facts : Ready or None
        The rig, once it is open.
    spot : Spot
        Place of the beam.
    levels : LevelMeasured or None
        Latest levels of the inputs.
    listening, sweeping : bool
        Whether levels arrive; whether a sweep is under way.
    sweep : SweepTaken or None
        The last one.
    revision : dict
        Counts changes of ``"state"``, ``"spot"``, ``"level"`` and ``"sweep"``.
    """

    def __init__(self, context: TabContext) -> None:
        self._context = context
        self._process: CommandProcess | None = None
        self._then: Callable[[], object] | None = None
        self.revision = {"state": 0, "spot": 0, "level": 0, "sweep": 0}
        self._reset()

    def _reset(self) -> None:
        self.state = "released"
        self.facts: Ready | None = None
        self.spot = Spot()
        self.levels: LevelMeasured | None = None
        self.listening = self.sweeping = False
        self.sweep: SweepTaken | None = None
        self._moving_to: Pair | None = None
        self._next: Pair | None = None

    @property
    def pid(self) -> int | None:
        return None if self._process is None else self._process.pid

    @property
    def held(self) -> bool:
        """Whether the instruments are open, or being opened."""
        return self._process is not None

    def take(self, rig: Path) -> None:
        if self._process is None:
            self._reset()
            arguments = ["operate", str(rig)]
            self._process = self._context.run(arguments, self._ended, self._receive, advice=LASER_ADVICE)
            self._enter("opening")

    def release(self, then: Callable[[], object] | None = None) -> None:
        """Mute, park and close the instruments; `then` is called when they are free."""
        if self._process is None:
            if then is not None:
                then()
            return
        self._then = then
        self._process.send(order="mute")
        self._process.close_input()
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
        here = None if self.spot.parked else self.spot.place_mm
        from_mm = self._next or self._moving_to or here or (0.0, 0.0)
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
        self._changed("sweep")
        self._order(
            order="sweep", actuator=actuator, level_v=level_v, start_hz=start_hz, stop_hz=stop_hz, duration_s=duration_s
        )

    def reconnect(self, role: str) -> None:
        self._order(order="reconnect", instrument=role)

    def detach(self) -> None:
        """Let the process mute, park and exit by itself; the window closes."""
        if self._process is not None:
            self._process.send(order="mute")
            self._process.detach()
            self._process = None

    def _order(self, **order: object) -> None:
        if self._process is not None and self.state == "ready":
            self._process.send(**order)

    def _receive(self, message: Message) -> None:
        match message_of(message, OPERATE_EVENTS):
            case Ready() as facts:
                self.facts = facts
                self._enter("ready")
            case MirrorMoved() as moved:
                self.spot = Spot.of(moved)
                self._changed("spot")
            case LevelsSwitched(on=on):
                self.listening = on
                self._changed("level")
            case LevelMeasured() as levels:
                self.levels, self.listening = levels, True
                self._changed("level")
            case SweepTaken() as sweep:
                self.sweep = sweep
                self._changed("sweep")
            case Done() as done:
                self._order_done(done)
            case Refused(sentence=sentence):
                self._context.messages.warn(sentence)
            case Faulted() as fault:
                self._report_fault(fault)

    def _report_fault(self, fault: Faulted) -> None:
        role = fault.instrument
        answers = []
        if self.state == "ready" and role in ("mirror", "recorder", "player"):
            answers = [(f"Reconnect the {role}", lambda: self.reconnect(role))]
        self._context.messages.fault(fault.sentence, *answers)
        if not fault.passing:
            self.listening = False
            self._changed("level")

    def _order_done(self, done: Done) -> None:
        match done.order:
            case "jog":
                self._moving_to, wanted, self._next = None, self._next, None
                if wanted is not None:
                    self.jog_to(*wanted)
            case "sweep":
                self.sweeping = False
                self._changed("sweep")
            case "mute":  # waiting orders were dropped without an answer
                self._moving_to, self.sweeping = None, False
                self._changed("sweep")
            case "reconnect" if done.ok:
                self._context.messages.note("reconnected")

    def _ended(self, process: CommandProcess) -> None:
        self._process = None
        expected, then = self.state == "ending", self._then
        self._then = None
        self._reset()
        self._enter("released")
        if process.failure:
            self._context.messages.fault(process.failure)
            return
        if not expected:
            self._context.messages.warn("wavefocus operate has ended; the outputs are muted, the mirror is parked")
        if then is not None:
            then()

    def _enter(self, state: str) -> None:
        self.state = state
        for name in self.revision:
            self._changed(name)

    def _changed(self, name: str) -> None:
        self.revision[name] += 1
