"""Mirrorcle MEMS mirrors on a USB or Bluetooth MTI controller in its command mode.

Sources: public drivers of laboratories, in agreement with each other: command mode is entered by ``$MTI$`` (answer
``MTI-Device MTI-MZ-2.3.113:USB Ready in Command Mode``) and left by ``MTI+EX``; ``MTI+EN`` and ``MTI+DI`` switch the
high voltage, and its settings cannot be changed while it is on; ``MTI+GT x y m`` points, x and y from -1 to 1, m a
digital output, here 0; answers are ``MTI-OK`` and ``MTI-ERR`` with a word, ``MTI-ERR InvalidCommand`` also to
``$MTI$`` within command mode. Commands end with a line feed.

Not confirmed: other words after ``MTI-ERR``; which models leave the factory at 115200 baud, as in those drivers, and
which at 460800, the default of the vendor's header: both are tried. There is no read-back and no busy query: a move
lasts the stated settling time. Between full deflections the angle is taken to be linear in x and y; what is not is the
mirror map's business.

Bias, largest difference and filter (``MTI+VB``, ``MTI+VD``, ``MTI+BW``) belong to the mirror's data sheet. They are
taken from the controller's memory, or sent as `setup` before the mirror is enabled.
"""

import math
import re
from dataclasses import dataclass

from wavefocus.drivers.dialogue import Dialogue, Marker, Query, RefusedError, RestartedError, UnreadableError
from wavefocus.drivers.protocols import DeviceIdentity
from wavefocus.drivers.registry import MIRRORS, rig_key
from wavefocus.drivers.serial_device import Dialect

_WITHIN_COMMAND_MODE = "MTI-ERR InvalidCommand"


@MIRRORS.register
@dataclass(kw_only=True)
class MirrorcleMti(Dialect):
    """The dialect ``mirrorcle-mti``; parked by a move, for disabled it would send the beam to the plate's middle."""

    full_scale_mrad: float = rig_key(
        "the optical angle at full scale in mrad: its commands have no unit",
        in_plan="always",
        gt=0,
        lt=1000 * math.pi / 2,
    )
    setup: tuple[str, ...] = rig_key(
        "Commands of the mirror's data sheet, sent before it is enabled, each answered by MTI-OK",
        default=(),
        in_plan="free",
    )

    name = "mirrorcle-mti"
    bauds = (115200, 460800)
    says_when_idle = False

    @property
    def reach_mrad(self) -> float:
        return self.full_scale_mrad

    def wake(self, dialogue: Dialogue, patience_s: float) -> str:
        # Only on entering command mode does the controller say who it is: leave it first.
        return dialogue.introduce(Query("$MTI$", _greeting), patience_s, before="MTI+EX")

    def device(self, identity: str) -> DeviceIdentity:
        return DeviceIdentity("Mirrorcle", identity)

    def marker(self, identity: str) -> Marker:
        def stranger(line: str) -> str | None:
            if not line.startswith("MTI-Device") or line.endswith("Exit Command Mode"):
                return None
            if line == identity:
                raise RestartedError(line)
            return line

        return Marker("$MTI$", identity, lambda line: line.endswith(_WITHIN_COMMAND_MODE), stranger)

    def enable(self, dialogue: Dialogue, park_mrad: tuple[float, float]) -> None:
        if self.setup:
            # It may still be enabled from before, and refuses settings then.
            dialogue.ask(Query("MTI+DI", _done), "disabling the mirror")
        for command in self.setup:
            dialogue.ask(Query(command, _done), f"setting up ({command})")
        dialogue.ask(Query("MTI+EN", _done), "enabling the mirror")

    def move(self, dialogue: Dialogue, x_mrad: float, y_mrad: float, doing: str) -> None:
        x, y = x_mrad / self.full_scale_mrad, y_mrad / self.full_scale_mrad
        dialogue.ask(Query(f"MTI+GT {x:.4f} {y:.4f} 0", _done), doing)


def _greeting(answer: str) -> str:
    if not answer.startswith("MTI-Device") or answer.endswith("Exit Command Mode"):
        raise UnreadableError(answer)
    return answer.strip()


def _done(answer: str) -> None:
    refusal = re.fullmatch(r"MTI-ERR ?([ -~]*)", answer)
    if refusal is not None:
        # The words are not documented; a disturbed command is an invalid one, so another try may go well.
        raise RefusedError(f"the controller answers {answer.strip()!r}", "see the controller's manual", passing=True)
    if answer.strip() != "MTI-OK":
        raise UnreadableError(answer)
