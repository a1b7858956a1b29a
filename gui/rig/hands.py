"""A rig in the window's hands: orders to ``wavefocus operate``, and what it told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gui.rig.facts import ChannelLevel, RigFacts, Spot, Sweep
from gui.rig.lines_process import LinesProcess, Told
from gui.shell.tab import TabContext

# x and y in millimetres.
Place = tuple[float, float]

NOWHERE = Spot(None, None, None, None, parked=False)


class Hands:
    """What is known of a rig that is operated by hand.

    Parameters
    ----------
    context : TabContext
        Starts commands, tells sentences.

    Attributes
    ----------
    state : str
        ``"released"``, ``"opening"``, ``"ready"`` or ``"ending"``.
    facts : RigFacts or None
        The rig, once it is open.
    spot : Spot
        Where the beam was sent.
    reference, response : ChannelLevel or None
        What is heard.
    light : float or None
        The vibrometer's signal level, 0 to 1.
    listening : bool
        Whether levels come.
    sweep : Sweep or None
        The last one.
    sweeping : bool
        Whether one is under way.
    revision : dict
        Counts changes of ``"state"``, ``"spot"``, ``"level"`` and ``"sweep"``.
    """

    def __init__(self, context: TabContext) -> None:
        self._context = context
        self._process: LinesProcess | None = None
        self._then: Callable[[], object] | None = None
        self.revision = {"state": 0, "spot": 0, "level": 0, "sweep": 0}
        self._forget()

    def _forget(self) -> None:
        self.state = "released"
        self.facts: RigFacts | None = None
        self.spot = NOWHERE
        self.reference: ChannelLevel | None = None
        self.response: ChannelLevel | None = None
        self.light: float | None = None
        self.listening = False
        self.sweep: Sweep | None = None
        self.sweeping = False
        self._under_way: Place | None = None
        self._wanted: Place | None = None

    @property
    def pid(self) -> int | None:
        """The process that holds the instruments."""
        return None if self._process is None else self._process.pid

    @property
    def held(self) -> bool:
        """Whether the instruments are in its hands, or on their way."""
        return self._process is not None

    def take(self, rig: Path) -> None:
        """Open the instruments of a rig."""
        if self._process is not None:
            return
        self._forget()
        self._process = LinesProcess.started(self._context, ["operate", str(rig)], "the instruments cannot be taken")
        if self._process is not None:
            self._enter("opening")

    def release(self, then: Callable[[], object] | None = None) -> None:
        """Mute, park and give the instruments back; `then` is called when they are free."""
        if self._process is None:
            if then is not None:
                then()
            return
        self._then = then
        self._process.send(order="mute")
        self._process.end()
        self._enter("ending")

    def jog_to(self, x_mm: float, y_mm: float) -> None:
        """Send the beam somewhere; of places wanted while it moves only the last counts."""
        if self.state != "ready":
            return
        if self._under_way is not None:
            self._wanted = x_mm, y_mm
            return
        self._under_way = x_mm, y_mm
        self._order(order="jog", x_mm=x_mm, y_mm=y_mm)

    def jog_by(self, x_mm: float, y_mm: float) -> None:
        """Send the beam so many millimetres further than where it is, or was told to go."""
        at = self._wanted or self._under_way
        if at is None and self.spot.x_mm is not None and self.spot.y_mm is not None and not self.spot.parked:
            at = self.spot.x_mm, self.spot.y_mm
        from_x_mm, from_y_mm = at or (0.0, 0.0)
        self.jog_to(round(from_x_mm + x_mm, 4), round(from_y_mm + y_mm, 4))

    def park(self) -> None:
        """Send the beam to its safe direction."""
        self._wanted = None
        self._order(order="park")

    def mute(self) -> None:
        """Be silent at once; what was ordered and not begun is dropped."""
        self._wanted = None
        self._order(order="mute")

    def listen(self, on: bool, actuator: int | None, level_v: float) -> None:
        """Let levels come, or not; while one actuator plays short sweeps, where one is named."""
        sounding = {} if actuator is None else {"actuator": actuator, "level_v": level_v}
        self._order(order="level", on=on, **sounding)

    def take_sweep(self, actuator: int, level_v: float, start_hz: float, stop_hz: float, duration_s: float) -> None:
        """Take one sweep."""
        self.sweeping = True
        self._changed("sweep")
        self._order(
            order="sweep", actuator=actuator, level_v=level_v, start_hz=start_hz, stop_hz=stop_hz, duration_s=duration_s
        )

    def reconnect(self, role: str) -> None:
        """Open an instrument afresh."""
        self._order(order="reconnect", instrument=role)

    def poll(self) -> None:
        """Take up what came in."""
        process = self._process
        if process is not None and process.hand_over(self._hear):
            self._ended(process)

    def let_go(self) -> None:
        """The window closes: mute, park, and no waiting for it."""
        if self._process is not None:
            self._process.send(order="mute")
            self._process.let_go()
            self._process = None

    def _order(self, **order: object) -> None:
        if self._process is not None and self.state == "ready":
            self._process.send(**order)

    def _hear(self, told: Told) -> None:
        match told.get("event"):
            case "ready":
                self.facts = RigFacts.told(told)
                self._enter("ready")
            case "mirror":
                self.spot = Spot.told(told)
                self._changed("spot")
            case "levels":
                self.listening = bool(told.get("on"))
                self._changed("level")
            case "level":
                self._hear_level(told)
            case "sweep":
                self.sweep = Sweep.told(told)
                self._changed("sweep")
            case "done":
                self._done(told)
            case "refused":
                self._context.messages.warn(str(told.get("sentence")))
            case "fault":
                self._hear_fault(told)

    def _hear_level(self, told: Told) -> None:
        reference, response, light = told.get("reference"), told.get("response"), told.get("light")
        if isinstance(reference, dict) and isinstance(response, dict):
            self.reference, self.response = ChannelLevel.told(reference), ChannelLevel.told(response)
            self.light = float(light) if isinstance(light, int | float) else None
            self.listening = True
            self._changed("level")

    def _hear_fault(self, told: Told) -> None:
        sentence, role = str(told.get("sentence")), str(told.get("instrument"))
        answers = []
        if self.state == "ready" and role in ("mirror", "recorder", "player"):
            answers = [(f"Connect the {role} afresh", lambda: self.reconnect(role))]
        self._context.messages.fault(sentence, *answers)
        if not told.get("passing"):
            self.listening = False
            self._changed("level")

    def _done(self, told: Told) -> None:
        order = told.get("order")
        if order == "jog":
            self._under_way = None
            if self._wanted is not None:
                wanted, self._wanted = self._wanted, None
                self.jog_to(*wanted)
        elif order == "sweep":
            self.sweeping = False
            self._changed("sweep")
        elif order == "mute":
            self._under_way, self.sweeping = None, False  # orders that waited were dropped without an answer
            self._changed("sweep")
        elif order == "reconnect" and told.get("ok"):
            self._context.messages.note("connected afresh")

    def _ended(self, process: LinesProcess) -> None:
        self._process = None
        wanted = self.state == "ending"
        self._forget()
        self._enter("released")
        ending = process.ending()
        if ending:
            self._context.messages.fault(ending)
        elif not wanted:
            self._context.messages.warn("wavefocus operate has ended; the outputs are muted, the mirror is parked")
        then, self._then = self._then, None
        if then is not None and not ending:
            then()

    def _enter(self, state: str) -> None:
        self.state = state
        for name in self.revision:
            self._changed(name)

    def _changed(self, name: str) -> None:
        self.revision[name] += 1
