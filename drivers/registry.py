"""Drivers by the name that the rig file gives them, and the keys of the rig file that each of them has.

A new driver is a module in its role's folder: a data class whose fields are its keys, registered by a decorator.
config/ makes the rig file's tables of these fields, so that no other file names the driver.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field
from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any, Generic, Literal, Protocol, TypeVar

if TYPE_CHECKING:
    from wavefocus.drivers.mirror.serial_mirror import Dialect
    from wavefocus.drivers.protocols import Player, Recorder


class Named(Protocol):
    """A class that is registered; ``name`` is what the rig file calls it."""

    name: str


Entry = TypeVar("Entry", bound=type[Named])


class Registry(Generic[Entry]):
    """Classes by name, registered in the modules of a package, which are imported when they are first asked for.

    A subfolder holds what only one driver needs; it is not searched.

    package: Where the modules are.
    """

    def __init__(self, package: str) -> None:
        self._package = package
        self._found: dict[str, Entry] = {}
        self._complete = False

    def register(self, entry: Entry) -> Entry:
        """Add a class; used as its decorator."""
        self._found[entry.name] = entry
        return entry

    def all(self) -> Mapping[str, Entry]:
        """Every class that is registered, by name."""
        if not self._complete:
            for module in iter_modules(import_module(self._package).__path__):
                if not module.ispkg:
                    import_module(f"{self._package}.{module.name}")
            self._complete = True
        return self._found


class KeyMistakeError(ValueError):
    """Keys of a driver that do not go together.

    key, value: The key that is wrong, and what it holds.
    allowed: What it may hold, as the end of a sentence.
    """

    def __init__(self, key: str, value: object, allowed: str) -> None:
        super().__init__(f"{key} {allowed}")
        self.key = key
        self.value = value
        self.allowed = allowed


def rig_key(
    title: str,
    description: str,
    *,
    default: Any = MISSING,
    in_plan: Literal["changed", "always", "free"] = "changed",
    pattern: tuple[str, str] | None = None,
    **bounds: float,
) -> Any:
    """A field of a driver: a key of its table in the rig file.

    title, description: For forms and reference pages; of a key without a default, the description also says what is
        missing.
    default: Where the key is left out; without one the key is needed.
    in_plan: A key must not change in a campaign unless it is ``"free"`` to, because rows measured with another value
        are of the same kind: an address, a time-out. ``"always"``: it is in the plan's hash at its default too, as in
        banks that are there; a new key is not, or their hash would change.
    pattern: A regular expression that texts match, and what is allowed, as the end of a sentence.
    **bounds: ``gt``, ``ge``, ``lt`` and ``le``, as of pydantic's ``Field``.
    """
    about = {"title": title, "description": description, "in_plan": in_plan, "pattern": pattern, "bounds": bounds}
    return field(default=default, metadata=about)


@dataclass(frozen=True, slots=True)
class Outputs:
    """The outputs that a rig needs of a player.

    full_scale_v: Volts at full scale of each output, from 0 to the highest that is wired.
    """

    full_scale_v: tuple[float, ...]
    rate_hz: int


class PlayerDriver(Named, Protocol):
    """Opens a player; its fields are the keys of ``[player]`` that it has."""

    def open(self, outputs: Outputs) -> Player:
        """Open the device. Raises InstrumentError."""
        ...


class RecorderDriver(Named, Protocol):
    """Opens a recorder; its fields are the keys of ``[recorder]`` that it has."""

    def open(self) -> Recorder:
        """Open the device. Raises InstrumentError."""
        ...


@dataclass(frozen=True, slots=True)
class VibrometerReading:
    """Settings of a vibrometer, as its controller states them.

    sensitivity_m_s_per_v: Velocity per volt at its output, > 0.
    range_text: The measurement range in the controller's own words.
    latency_s: How much later its output follows the surface, typically, for this decoder and range; None where it does
        not say.
    signal_level: Strength of the reflected light, 0 to 1; None where it does not say.
    identity: Controller and velocity decoder.
    """

    sensitivity_m_s_per_v: float
    range_text: str
    latency_s: float | None
    signal_level: float | None
    identity: str


class VibrometerDriver(Named, Protocol):
    """Asks a vibrometer; its fields are the keys of ``[vibrometer]`` that it has."""

    def read(
        self, port: str, *, baud: int | None = None, identity: str | None = None, any_level: bool = False
    ) -> VibrometerReading:
        """Ask the controller and leave it alone again; a signal too weak is an error unless any level will do.

        Raises InstrumentError: it does not answer, is another device, or has too weak a signal.
        """
        ...


MIRRORS: Registry[type[Dialect]] = Registry("wavefocus.drivers.mirror")
RECORDERS: Registry[type[RecorderDriver]] = Registry("wavefocus.drivers.daq")
PLAYERS: Registry[type[PlayerDriver]] = Registry("wavefocus.drivers.audio")
VIBROMETERS: Registry[type[VibrometerDriver]] = Registry("wavefocus.drivers.vibrometer")
