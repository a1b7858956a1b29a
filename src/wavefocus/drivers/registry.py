"""Drivers by the name that the rig file gives them, and the keys of the rig file that each of them has.

A new driver is a module in its role's folder: a data class whose fields are its keys, registered by a decorator.
Another distribution adds one with an entry point (docs/how-to/write-a-driver.md). config/ makes the rig file's tables
of these fields, so that no other file names the driver.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from inspect import isabstract
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_type_hints

if TYPE_CHECKING:
    from wavefocus.drivers.protocols import Clock

Entry = TypeVar("Entry", bound=type[Any])


class Registry:
    """Classes by their ``name``, registered in the modules of a package, which are imported when first asked for.

    A subfolder holds what only one driver needs; it is not searched. Entry points of other distributions come after
    them. One that cannot be used, for a package that is not installed or another reason, is left out, so that it harms
    no rig but its own; `failures` says why.

    package: Where the modules are.
    group: Name of the group of entry points; each is a class, and its name that of the driver.
    method: What the class must be able to do. Both are empty where only modules of `package` register.

    sources: Whose the classes of other distributions are, by name.
    """

    def __init__(self, package: str, group: str = "", method: str = "") -> None:
        self._package = package
        self._group = group
        self._method = method
        self._found: dict[str, type[Any]] = {}
        self._complete = False
        self.sources: dict[str, str] = {}
        self.failures: dict[str, str] = {}

    def register(self, entry: Entry) -> Entry:
        """Add a class; used as its decorator."""
        self._found[entry.name] = entry
        return entry

    def all(self) -> Mapping[str, type[Any]]:
        """Every class that is registered, by name."""
        if not self._complete:
            for module in iter_modules(import_module(self._package).__path__):
                if not module.ispkg:
                    self._load(f"{self._package}.{module.name}")
            self._complete = True  # before other distributions' modules run, which may ask
            for point in _all_entry_points().select(group=self._group) if self._group else ():
                self._add(point)
        return self._found

    def leave_out(self, name: str, why: str) -> None:
        """Remove a driver that cannot be used; `failures` has the reason."""
        self._found.pop(name, None)
        self.failures[name] = f"{self.sources.get(name, self._package)} {why}"

    def _load(self, module: str) -> None:
        """Import a module; a driver whose maker's package is missing harms no rig but its own."""
        try:
            import_module(module)
        except ImportError as missing:
            if (missing.name or "").partition(".")[0] == "wavefocus":
                raise
            name = module.rpartition(".")[2].replace("_", "-")
            self.failures[name] = f"{module} cannot be loaded: {type(missing).__name__}: {missing}"

    def _add(self, point: EntryPoint) -> None:
        """Load another distribution's driver, or say why it cannot be used."""
        source = f"{point.value} of {f'{point.dist.name} {point.dist.version}' if point.dist else 'no distribution'}"
        try:
            entry = point.load()
            fault = self._fault(entry, point.name)
        except KeyboardInterrupt:
            raise
        except BaseException as failure:  # another program's, which must not end this one
            fault = f"cannot be loaded: {type(failure).__name__}: {failure}"
        if fault:
            self.failures[point.name] = f"{source} {fault}"
        else:
            self._found[point.name], self.sources[point.name] = entry, source

    def _fault(self, entry: Any, name: str) -> str:
        """Why a class is not a driver for this role; empty if it is one."""
        if not (isinstance(entry, type) and is_dataclass(entry)):
            return "is not a data class"
        if getattr(entry, "name", None) != name:
            return f"has the name {getattr(entry, 'name', None)!r}, and its entry point {name!r}: they must be equal"
        if name in self._found:
            return f"has the name of a driver that is there already: {self._found[name].__module__}"
        if isabstract(entry) or not callable(getattr(entry, self._method, None)):
            missing = sorted(getattr(entry, "__abstractmethods__", ())) or [self._method]
            return f"lacks {', '.join(missing)}"
        hints = get_type_hints(entry)
        for key in fields(entry):
            if "in_plan" not in key.metadata:
                return f"has a field that is not declared with rig_key: {key.name}"
            for other in self._found.values():
                theirs = {field.name for field in fields(other)}
                if key.name in theirs and get_type_hints(other)[key.name] != hints[key.name]:
                    return f"has a key that driver {other.name} has with another type: {key.name}"
        return ""


@cache
def _all_entry_points() -> Any:
    """Read once: to look through every installed distribution takes some 10 ms; its type changed in Python 3.12."""
    return entry_points()


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
    description: str,
    *,
    default: Any = MISSING,
    in_plan: Literal["changed", "always", "free"] = "changed",
    pattern: tuple[str, str] | None = None,
    **bounds: float,
) -> Any:
    """A field of a driver: a key of its table in the rig file.

    description: For comments in files and reference pages; of a key without a default, it also says what is missing.
    default: Where the key is left out; without one the key is needed.
    in_plan: A key must not change in a campaign unless it is ``"free"`` to, because rows measured with another value
        are of the same kind: an address, a time-out. ``"always"``: it is in the plan's hash at its default too, as in
        banks that are there; a new key is not, or their hash would change.
    pattern: A regular expression that texts match, and what is allowed, as the end of a sentence.
    **bounds: ``gt``, ``ge``, ``lt`` and ``le``, as in pydantic's ``Field``.
    """
    about = {"description": description, "in_plan": in_plan, "pattern": pattern, "bounds": bounds}
    return field(default=default, metadata=about)


@dataclass(frozen=True, slots=True)
class Outputs:
    """The outputs that a rig needs of a player.

    full_scale_v: Volts at full scale of each output, from 0 to the highest that is wired.
    """

    full_scale_v: tuple[float, ...]
    rate_hz: int


@dataclass(frozen=True, slots=True, kw_only=True)
class MirrorSettings:
    """Keys of ``[mirror]`` that every mirror has.

    port: Where a mirror on a serial line is; empty for others.
    baud: Bits per second; None for the driver's own.
    identity: Text that the device's identification must contain; None: any.
    settle_s: How long the beam swings after a move, >= 0.
    limit_mrad: Largest optical angle in x and in y, > 0; moves beyond it are refused.
    park_mrad: The safe direction, within the limit.
    clock: The time that `Mirror.wait_settled` goes by.
    """

    port: str = ""
    baud: int | None = None
    identity: str | None = None
    settle_s: float
    limit_mrad: float
    park_mrad: tuple[float, float]
    clock: Clock


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


MIRRORS = Registry("wavefocus.drivers.mirror", "wavefocus.mirrors", "open")
"""`open(settings: MirrorSettings) -> Mirror` opens the device without moving it.

Optional attributes: `table_defaults`, a mapping from keys that every mirror has to other defaults, and `without_keys`,
those of ``port``, ``baud`` and ``identity`` that it does not have. The methods of all drivers raise InstrumentError.
"""

RECORDERS = Registry("wavefocus.drivers.daq", "wavefocus.recorders", "open")
"""`open() -> Recorder` opens the device."""

PLAYERS = Registry("wavefocus.drivers.audio", "wavefocus.players", "open")
"""`open(outputs: Outputs) -> Player` opens the device."""

SHUTTERS = Registry("wavefocus.drivers.shutter", "wavefocus.shutters", "open")
"""`open() -> Shutter` opens the device without moving it."""

VIBROMETERS = Registry("wavefocus.drivers.vibrometer", "wavefocus.vibrometers", "read")
"""`read(port: str, *, baud: int | None, identity: str | None, any_level: bool) -> VibrometerReading` asks the
controller and releases it again; a signal too weak is an error unless any level will do.
"""
