"""Devices on a serial line: a scanning mirror with the base of its dialects, and the base of vibrometers.

Each device family is a module of drivers/mirror/ or drivers/vibrometer/.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, TypeVar

from wavefocus.drivers.dialogue import Dialogue, Marker, Query
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.protocols import Clock, DeviceIdentity, Mirror
from wavefocus.drivers.registry import MirrorSettings, VibrometerReading, rig_key
from wavefocus.drivers.serial_line import NETWORK, LineSettings, SerialLine


class Dialect(ABC):
    """Speaks to one family of mirrors; angles are optical angles in mrad, the device's own units stay inside.

    A dialect is a data class: its fields are the keys of ``[mirror]`` that it has besides those of every mirror.
    It may keep what it learnt of the device in `wake` and `enable`; both run at every open.

    name: In the rig file.
    table_defaults: Keys of every mirror that have another default with this one.
    bauds: Bits per second as the device leaves the factory; where there are several, they are tried in this order.
    command_end: What ends a command.
    encoding: Of commands and answers, see `wavefocus.drivers.serial_line.LineSettings`.
    patience_s: How long the device may take to answer once its port is open.
    says_when_idle: Whether the device can be asked if it moves.
    tolerance_mrad: How far from its target a mirror that reads back may stand.
    """

    name: str
    table_defaults: Mapping[str, object] = {}
    bauds: tuple[int, ...] = (115200,)
    command_end = "\n"
    encoding = "ascii"
    patience_s = 2.0
    says_when_idle = True
    tolerance_mrad: float = math.inf

    def open(self, settings: MirrorSettings) -> SerialMirror:
        """Open the mirror that speaks this dialect. Raises InstrumentError."""
        return SerialMirror(self, settings)

    @property
    @abstractmethod
    def reach_mrad(self) -> float:
        """Largest angle on either axis that can be sent to the device; it may be read only in `enable`."""

    def reaches(self, x_mrad: float, y_mrad: float) -> bool:
        """Whether the device can point there."""
        return max(abs(x_mrad), abs(y_mrad)) <= self.reach_mrad

    @abstractmethod
    def wake(self, dialogue: Dialogue, patience_s: float) -> str:
        """Make the device listen, within `patience_s`, and return its identity. Raises InstrumentError."""

    @abstractmethod
    def device(self, identity: str) -> DeviceIdentity:
        """Who the device is, from the identity that `wake` returned, its white space made single blanks."""

    @abstractmethod
    def marker(self, identity: str) -> Marker:
        """How to recognise this device among its answers."""

    @abstractmethod
    def enable(self, dialogue: Dialogue, park_mrad: tuple[float, float]) -> None:
        """Prepare the device for moves. Raises InstrumentError."""

    @abstractmethod
    def move(self, dialogue: Dialogue, x_mrad: float, y_mrad: float, doing: str) -> None:
        """Start a move. Raises InstrumentError."""

    def park(self, dialogue: Dialogue, park_mrad: tuple[float, float]) -> None:
        """Start the move to the safe direction. Raises InstrumentError."""
        self.move(dialogue, *park_mrad, "parking")

    def moving(self, dialogue: Dialogue, doing: str) -> bool:
        """Whether the device says that it moves. Raises InstrumentError."""
        return False

    def where_mrad(self, dialogue: Dialogue, doing: str) -> tuple[float, float] | None:
        """Where the device says that it points; None where it cannot say. Raises InstrumentError."""
        return None


def tolerance_key() -> Any:
    """The key ``tolerance_mrad`` of a mirror that reads back."""
    return rig_key("How far off its target a mirror that reads back may stand", default=0.5, in_plan="free", gt=0)


# Pause between two questions whether the mirror still moves.
_POLL_S = 0.001


class SerialMirror(Mirror):
    """Points the laser over a serial line.

    The constructor opens the port, checks who answers, and enables the mirror; it does not move it.

    Raises InstrumentError or InstrumentLostError.

    settings: Its baud is the dialect's by default, one after the other where it has several. Whatever answers at the
        first open must be the same at every other. `settle_s` counts from when the device says that it stands, or,
        where it cannot say so, from when the move was acknowledged.
    answer_s: Longest wait for one answer, in s, > 0.
    patience_s: How long a device whose port was just opened may take until it answers, in s; by default the dialect's.
    """

    def __init__(
        self, dialect: Dialect, settings: MirrorSettings, *, answer_s: float = 1.0, patience_s: float | None = None
    ) -> None:
        self._name = f"mirror ({dialect.name} at {settings.port})"
        self._dialect, self._settings, self._clock = dialect, settings, settings.clock
        self._identity: str | None = None
        self._answer_s = answer_s
        self._patience_s = dialect.patience_s if patience_s is None else patience_s
        self._closed = False
        self._target_mrad: tuple[float, float] | None = None
        self._standing_since_s: float | None = None
        self._settled = False
        self._astray = ""
        self._check_settings()
        # The one that was answered last comes first.
        self._bauds = list(dialect.bauds if settings.baud is None else (settings.baud,))
        if settings.port.startswith(NETWORK):
            del self._bauds[1:]  # the serial server has its own
        self._dialogue = self._new_dialogue(self._bauds[0])
        self._open()

    # -- the role ----------------------------------------------------------------------------------

    @property
    def identity(self) -> DeviceIdentity:
        """Who the device said it is when it was opened."""
        return self._dialect.device(_words(self._identity or ""))

    def identify(self) -> str:
        """Name of the device, after making sure that it still answers."""
        self._check_open("identifying")
        self._dialogue.verify("identifying")
        at = f" at {self._bauds[0]} baud" if len(self._bauds) > 1 else ""
        return f"{self._name}: {_words(self._identity or '')}{at}, within ±{self._settings.limit_mrad:g} mrad"

    def move_to(self, x_mrad: float, y_mrad: float) -> None:
        doing = f"moving to ({x_mrad:.3f}, {y_mrad:.3f}) mrad"
        self._check_open(doing)
        self._check_reach(x_mrad, y_mrad, doing)
        self._start(lambda: self._dialect.move(self._dialogue, x_mrad, y_mrad, doing), (x_mrad, y_mrad))

    def wait_settled(self, timeout_s: float) -> None:
        """Return when the beam stands still where it was sent.

        It ends after `timeout_s` and what a question under way then still takes, see
        `wavefocus.drivers.dialogue.Dialogue.ask`. Raises TransientInstrumentError.
        """
        self._check_open("settling")
        gives_up_s = self._clock.now_s() + timeout_s
        cause = "still moving"
        if self._astray:
            raise TransientInstrumentError(self._name, "settling", self._astray, "send it there again")
        while not self._settled:
            if self._clock.now_s() >= gives_up_s:
                raise TransientInstrumentError(
                    self._name,
                    "settling",
                    f"{cause} after {timeout_s:g} s",
                    "allow more time to settle; check that nothing holds or drives the mirror",
                )
            cause = self._look(gives_up_s) or cause

    def park(self) -> None:
        """Move to the safe direction; a lost device is given one more chance. Does nothing once closed."""
        if self._closed:
            return
        park_mrad = self._settings.park_mrad
        try:
            self._start(lambda: self._dialect.park(self._dialogue, park_mrad), park_mrad)
        except InstrumentLostError:
            self._open()
            self._start(lambda: self._dialect.park(self._dialogue, park_mrad), park_mrad)

    def reconnect(self) -> None:
        """Open the same port again, make sure that the same device answers, and enable it."""
        self._check_open("reconnecting")
        self._open()
        self._astray = "it has been sent nowhere since it was opened again"

    def close(self) -> None:
        """Release the port; the mirror stays where it is. Twice does no harm."""
        self._closed = True
        self._dialogue.close()

    # -- beyond the role -----------------------------------------------------------------------------

    def where_mrad(self) -> tuple[float, float] | None:
        """Where the device says that it points, optical mrad; None where the dialect has no read-back.

        Raises InstrumentError.
        """
        self._check_open("reading the position")
        return self._dialect.where_mrad(self._dialogue, "reading the position")

    # -- inside --------------------------------------------------------------------------------------

    def _open(self) -> None:
        self._forget_move()
        # A call that hangs keeps the old dialogue and is not waited for.
        self._dialogue.close()
        try:
            identity = self._wake()
            if self._stranger(identity):
                # One disturbed answer is not another device.
                identity = self._dialect.wake(self._dialogue, self._patience_s)
            if stranger := self._stranger(identity):
                remedy = "plug in the right device, or correct the rig file, identity"
                raise InstrumentError(self._name, "asking who it is", stranger, remedy)
            self._dialogue.recognise(self._dialect.marker(identity))
            self._dialect.enable(self._dialogue, self._settings.park_mrad)
            self._check_settings()
        except BaseException:
            self._dialogue.close()
            raise
        self._identity = identity
        self._standing_since_s = None if self._dialect.says_when_idle else self._clock.now_s()

    def _wake(self) -> str:
        """Open the port at the first baud at which the device says who it is. Raises InstrumentError."""
        for baud in list(self._bauds):
            self._dialogue = self._new_dialogue(baud)
            self._dialogue.open()
            try:
                identity = self._dialect.wake(self._dialogue, self._patience_s)
            except InstrumentLostError as silent:
                self._dialogue.close()
                latest = silent
            else:
                self._bauds.sort(key=lambda other: other != baud)
                return identity
        if len(self._bauds) == 1:
            raise latest
        cause = f"{latest.cause}; at {' and '.join(map(str, self._bauds))} baud alike"
        raise InstrumentLostError(latest.instrument, latest.operation, cause, latest.remedy) from latest

    def _new_dialogue(self, baud: int) -> Dialogue:
        settings = LineSettings(baud, self._dialect.command_end, self._answer_s, self._dialect.encoding)
        return Dialogue(self._name, SerialLine(self._name, self._settings.port, settings), self._clock)

    def _stranger(self, identity: str) -> str:
        """Why this is not the device that is wanted; empty if it is."""
        says, wanted = _words(identity), self._settings.identity
        if wanted is not None and wanted not in says:
            return f"another device answers: {says!r} does not contain {wanted!r}"
        if self._identity is not None and identity != self._identity:
            return f"another device answers in its place: {says!r}, and not {_words(self._identity)!r}"
        return ""

    def _start(self, command: Callable[[], None], target_mrad: tuple[float, float]) -> None:
        self._forget_move()
        self._astray = "the latest move failed"
        command()
        self._astray = ""
        self._target_mrad = target_mrad
        if not self._dialect.says_when_idle:
            self._standing_since_s = self._clock.now_s()

    def _forget_move(self) -> None:
        self._target_mrad, self._standing_since_s, self._settled = None, None, False

    def _look(self, gives_up_s: float) -> str:
        """Look once whether the beam stands; says why not, where that is news."""
        if self._dialect.says_when_idle:
            if self._dialect.moving(self._dialogue, "settling"):
                self._standing_since_s = None
                self._clock.sleep(_POLL_S)
                return "still moving"
            if self._standing_since_s is None:
                # It rests now; since when, it does not say.
                self._standing_since_s = self._clock.now_s()
        left_s = self._settings.settle_s - (self._clock.now_s() - (self._standing_since_s or 0.0))
        if left_s > 0:
            self._clock.sleep(min(left_s, gives_up_s - self._clock.now_s()))
            return ""
        where_mrad = self._dialect.where_mrad(self._dialogue, "settling")
        target_mrad = self._target_mrad
        if where_mrad is None or target_mrad is None or self._is_near(where_mrad, target_mrad):
            self._settled = True
            return ""
        self._standing_since_s = None
        self._clock.sleep(_POLL_S)
        stands, sent = (f"({x:.3f}, {y:.3f}) mrad" for x, y in (where_mrad, target_mrad))
        return f"standing at {stands} and not at {sent}"

    def _is_near(self, one_mrad: tuple[float, float], other_mrad: tuple[float, float]) -> bool:
        return max(abs(one_mrad[0] - other_mrad[0]), abs(one_mrad[1] - other_mrad[1])) <= self._dialect.tolerance_mrad

    def _check_settings(self) -> None:
        """Hold the rig file against what the device can reach, as far as that has been read."""
        reach_mrad = self._dialect.reach_mrad
        if self._settings.limit_mrad > reach_mrad:
            cause = f"limit_mrad is {self._settings.limit_mrad:g}, and the device ends at {reach_mrad:.4g} mrad"
            remedy = f"lower limit_mrad and park_mrad of [mirror] in the rig file to {reach_mrad:.4g} or less"
            raise InstrumentError(self._name, "preparing", cause, remedy)
        self._check_reach(*self._settings.park_mrad, "preparing to park")

    def _check_reach(self, x_mrad: float, y_mrad: float, doing: str) -> None:
        limit = self._settings.limit_mrad
        if not (abs(x_mrad) <= limit and abs(y_mrad) <= limit):
            cause = f"({x_mrad:g}, {y_mrad:g}) mrad is beyond the limit of ±{limit:g} mrad"
            raise InstrumentError(self._name, doing, cause, "choose a grid within the mirror's reach")
        if not self._dialect.reaches(x_mrad, y_mrad):
            cause = f"the device cannot point to ({x_mrad:g}, {y_mrad:g}) mrad"
            raise InstrumentError(self._name, doing, cause, "choose a grid and park_mrad within its reach")

    def _check_open(self, doing: str) -> None:
        if self._closed:
            raise InstrumentError(self._name, doing, "it is closed", "open the rig again")


def _words(identity: str) -> str:
    return " ".join(identity.split())


Answer = TypeVar("Answer")


class SerialVibrometer(ABC):
    """A controller that states its measurement range over a serial line.

    least_signal_level: Smallest signal level that will do, 0 to 1.
    """

    name: str
    least_signal_level: float
    default_baud: ClassVar[int]
    encoding: ClassVar[str] = "ascii"

    @abstractmethod
    def ask(self, dialogue: Dialogue, require_identity: Callable[[str], None]) -> VibrometerReading:
        """Ask for all settings.

        require_identity: Called with the names that controller and decoder give; raises InstrumentError where the rig
            file's identity is not part of them.

        Raises InstrumentError, TransientInstrumentError or InstrumentLostError.
        """

    def read(
        self,
        port: str,
        *,
        baud: int | None = None,
        identity: str | None = None,
        any_level: bool = False,
        answer_s: float = 1.0,
        clock: Clock | None = None,
    ) -> VibrometerReading:
        """Ask for the sensitivity that it is set to, and release the controller again.

        port: A device path, ``"COM3"``, ``"socket://host:port"`` or ``"serial-number:ABC123"``.
        baud: Bits per second; by default the controller's own.
        identity: Text that the names of controller and decoder must contain.
        any_level: Whether a signal below `least_signal_level` will do.
        answer_s: Longest wait for one answer, in s, > 0.
        clock: Passes the time while the controller starts; by default the wall's.

        Raises InstrumentError, TransientInstrumentError or InstrumentLostError.
        """
        instrument = f"vibrometer ({self.name} at {port})"
        settings = LineSettings(baud or self.default_baud, "\n", answer_s, self.encoding)
        dialogue = Dialogue(instrument, SerialLine(instrument, port, settings), clock)

        def require_identity(stated: str) -> None:
            if identity is not None and identity not in stated:
                cause = f"another device answers: {stated!r} does not contain {identity!r}"
                remedy = "plug in the right device, or correct the rig file, identity"
                raise InstrumentError(instrument, "asking who it is", cause, remedy)

        dialogue.open()
        try:
            reading = self.ask(dialogue, require_identity)
        finally:
            dialogue.close()
        level = reading.signal_level
        if level is not None and level < self.least_signal_level and not any_level:
            cause = f"it is {100 * level:.0f} % of full, at least {100 * self.least_signal_level:.0f} % is wanted"
            remedy = "focus the laser; put reflective film on the surface"
            raise InstrumentError(instrument, "checking the signal level", cause, remedy)
        return reading


def optional_answer(dialogue: Dialogue, query: Query[Answer]) -> Answer | None:
    """The answer, or None where the controller has none that can be read. Raises InstrumentLostError."""
    try:
        return dialogue.ask(query, f"asking {query.text}")
    except InstrumentLostError:
        raise
    except InstrumentError:
        return None
