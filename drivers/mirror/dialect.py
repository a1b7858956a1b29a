"""The dialects of mirrors on serial lines; each device family has a module of its own in this folder."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from drivers.protocols import DeviceIdentity
from drivers.registry import rig_key
from drivers.serial_line.dialogue import Dialogue, Marker


class Dialect(ABC):
    """Speaks to one family of mirrors; angles are optical angles in mrad, the device's own units stay inside.

    A dialect is a data class: its fields are the keys of ``[mirror]`` that it has besides those of every mirror.
    It may keep what it learnt of the device in `wake` and `enable`; both run at every open.

    name: In the rig file.
    table_defaults: Keys of every mirror that have another default with this one.
    baud: Bits per second as the device leaves the factory.
    command_end: What ends a command.
    encoding: Of commands and answers, see `drivers.serial_line.line.LineSettings`.
    patience_s: How long the device may take to answer once its port is open.
    says_when_idle: Whether the device can be asked if it moves.
    tolerance_mrad: How far from its target a mirror that reads back may stand.
    """

    name: str
    table_defaults: Mapping[str, object] = {}
    baud = 115200
    command_end = "\n"
    encoding = "ascii"
    patience_s = 2.0
    says_when_idle = True
    tolerance_mrad: float = math.inf

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
    return rig_key("Tolerance", "How far off its target a mirror that reads back may stand", default=0.5, gt=0)
