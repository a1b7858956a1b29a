"""What a mirror's dialect must do; each device family has a module of its own."""

from __future__ import annotations

from typing import Protocol

from drivers.protocols import DeviceIdentity
from drivers.serial_line.dialogue import Dialogue, Marker


class Dialect(Protocol):
    """Speaks to one family of mirrors; angles are optical angles in mrad, the device's own units stay inside.

    A dialect may keep what it learnt of the device in `wake` and `enable`; both run at every open.
    """

    @property
    def baud(self) -> int:
        """Bits per second as the device leaves the factory."""
        ...

    @property
    def command_end(self) -> str:
        """What ends a command."""
        ...

    @property
    def encoding(self) -> str:
        """Of commands and answers, see `drivers.serial_line.line.LineSettings`."""
        ...

    @property
    def patience_s(self) -> float:
        """How long the device may take to answer once its port is open."""
        ...

    @property
    def reach_mrad(self) -> float:
        """Largest angle on either axis that can be sent to the device; it may be known only after `enable`."""
        ...

    def reaches(self, x_mrad: float, y_mrad: float) -> bool:
        """Whether the device can point there."""
        ...

    @property
    def says_when_idle(self) -> bool:
        """Whether the device can be asked if it moves."""
        ...

    def wake(self, dialogue: Dialogue, patience_s: float) -> str:
        """Make the device listen, within `patience_s`, and return its identity. Raises InstrumentError."""
        ...

    def device(self, identity: str) -> DeviceIdentity:
        """Who the device is, from the identity that `wake` returned, its white space made single blanks."""
        ...

    def marker(self, identity: str) -> Marker:
        """How to recognise this device among its answers."""
        ...

    def enable(self, dialogue: Dialogue, park_mrad: tuple[float, float]) -> None:
        """Prepare the device for moves. Raises InstrumentError."""
        ...

    def move(self, dialogue: Dialogue, x_mrad: float, y_mrad: float, doing: str) -> None:
        """Start a move. Raises InstrumentError."""
        ...

    def park(self, dialogue: Dialogue, park_mrad: tuple[float, float]) -> None:
        """Start the move to the safe direction. Raises InstrumentError."""
        ...

    def moving(self, dialogue: Dialogue, doing: str) -> bool:
        """Whether the device says that it moves. Raises InstrumentError."""
        ...

    def where_mrad(self, dialogue: Dialogue, doing: str) -> tuple[float, float] | None:
        """Where the device says that it points; None where it cannot say. Raises InstrumentError."""
        ...
