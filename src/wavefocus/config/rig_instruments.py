"""Mirror, recorder, vibrometer and player of a rig file; their keys depend on the driver, which states its own.

See `wavefocus.drivers.registry`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from pydantic import Field, create_model, model_validator

from wavefocus.config.fields import (
    ALWAYS,
    DERIVED,
    FREE,
    Finite,
    Matrix,
    NonNegative,
    Positive,
    Table,
    Text,
    Whole,
    default,
    like,
    mistake,
    plan_mark,
)
from wavefocus.config.loading import shown
from wavefocus.drivers.daq.nidaqmx import ANALOG_INPUT
from wavefocus.drivers.registry import MIRRORS, PLAYERS, RECORDERS, SHUTTERS, VIBROMETERS, KeyMistakeError, Registry

Section = TypeVar("Section", bound="DriverTable")


class DriverTable(Table):
    """A table with a key ``driver``, keys of every driver, and keys of single ones, which are None elsewhere.

    Attributes
    ----------
    drivers : mapping from name to data class
        The drivers that have keys.
    shared_keys : mapping from key to str
        Keys that each of these has; what is missing, if it is needed, else empty. A driver is without those that it
        names in an attribute ``without_keys``.
    left_out : mapping from name to str
        Drivers of other distributions that cannot be used, and why.
    """

    drivers: ClassVar[Mapping[str, type[Any]]] = {}
    shared_keys: ClassVar[Mapping[str, str]] = {}
    left_out: ClassVar[Mapping[str, str]] = {}

    driver: Annotated[str, ALWAYS] = "virtual"

    if TYPE_CHECKING:

        def __getattr__(self, key: str) -> Any: ...

    def make_driver(self) -> Any:
        """The driver, with its keys. Raises KeyMistakeError where they do not go together."""
        driver = self.drivers[self.driver]
        values = {key.name: getattr(self, key.name) for key in fields(driver)}
        return driver(**{key: value for key, value in values.items() if value is not None})

    def _unused_in_plan(self) -> frozenset[str]:
        """Keys of other drivers."""
        own = {key.name for key in fields(self.drivers[self.driver])} if self.driver in self.drivers else set()
        return frozenset(key.name for driver in self.drivers.values() for key in fields(driver)) - own

    def _plan_default(self, key: str) -> object:
        """The driver's own default of its key."""
        driver = self.drivers.get(self.driver)
        own = {key.name: key.default for key in fields(driver)} if driver is not None else {}
        return own[key] if own.get(key, MISSING) is not MISSING else super()._plan_default(key)

    @model_validator(mode="before")
    @classmethod
    def _driver_defaults(cls, data: Any) -> Any:
        """Fill in the driver's own defaults, so that the validated table says everything outright."""
        default = cls.model_fields["driver"].default
        name = data.get("driver", default) if isinstance(data, dict) else None
        if not isinstance(name, str) or name not in cls.drivers:
            if isinstance(name, str) and name in cls.left_out and name != default:
                raise mistake("driver", name, f"cannot be used: {cls.left_out[name]}")
            return data
        driver = cls.drivers[name]
        own = {key.name: key.default for key in fields(driver) if key.default not in (MISSING, None)}
        own |= getattr(driver, "table_defaults", {})
        given = {key: value for key, value in data.items() if value is not None or key not in own}
        return {**own, **given}

    @model_validator(mode="after")
    def _driver_keys(self: Section) -> Section:
        """Refuse keys that belong to another driver, and miss those that this one cannot do without."""
        owners = {
            key: [name for name, driver in self.drivers.items() if key not in getattr(driver, "without_keys", ())]
            for key in self.shared_keys
        }
        needed = {(name, key): text for key, text in self.shared_keys.items() if text for name in owners[key]}
        for name, driver in self.drivers.items():
            for field in fields(driver):
                owners.setdefault(field.name, []).append(name)
                if field.default is MISSING:
                    needed[name, field.name] = field.metadata["description"]
        for key, names in owners.items():
            value = getattr(self, key)
            if value is not None and self.driver not in names:
                belongs = _either([shown(name) for name in names])
                raise mistake(key, value, f"belongs to driver {belongs}; the driver here is {shown(self.driver)}")
            if value is None and (self.driver, key) in needed:
                wanted = needed[self.driver, key]
                raise mistake(key, None, f"is missing; driver {shown(self.driver)} needs {wanted}")
        if self.driver in self.drivers:
            try:
                self.make_driver()
            except KeyMistakeError as wrong:
                raise mistake(wrong.key, wrong.value, wrong.allowed) from None
            except Exception as failure:  # of another distribution's driver
                raise mistake("driver", self.driver, f"cannot be used: {_words(failure)}") from failure
        return self


def _with_drivers(section: type[Section], registry: Registry) -> type[Section]:
    """The table with the keys of all its drivers; two drivers with a key of one name mean the same by it.

    Another distribution's driver with a key of the table's own, or with keys that are none, is left out.
    """
    default = section.model_fields["driver"].default
    for name, driver in list(registry.all().items()):
        taken = [key.name for key in fields(driver) if key.name in section.model_fields]
        if taken:
            registry.leave_out(name, f"has a key that the table has: {', '.join(taken)}")
        elif name == default:
            registry.leave_out(name, f"has the name of a driver that is there already: {name}")
        elif name in registry.sources:
            try:
                create_model("Keys", **_keys(driver))
            except Exception as failure:
                registry.leave_out(name, f"has keys that cannot be read: {_words(failure)}")
    drivers = registry.all()
    mark = plan_mark(section.model_fields["driver"])
    keys: dict[str, Any] = {"driver": (Annotated[Literal[(default, *drivers)], mark], default)}
    for driver in drivers.values():
        keys |= _keys(driver)
    module = section.__module__
    made = create_model(section.__name__, __base__=section, __doc__=section.__doc__, __module__=module, **keys)
    made.drivers = drivers
    made.left_out = registry.failures
    return made


def _keys(driver: type[Any]) -> dict[str, Any]:
    """The keys of a driver as `create_model` takes them."""
    hints, keys = get_type_hints(driver), {}
    for key in fields(driver):
        about = key.metadata
        described = default(None, about["description"])
        checked: Any = Union[_checked(hints[key.name], about), None]  # noqa: UP007
        mark = {"free": FREE, "always": ALWAYS}.get(about["in_plan"])
        keys[key.name] = (Annotated[checked, mark] if mark else checked, described)
    return keys


def _words(failure: Exception) -> str:
    return f"{type(failure).__name__}: {failure}".partition("\n")[0]


def _checked(hint: Any, about: Mapping[str, Any]) -> Any:
    """A type as strict as those of every table, within the bounds of a key."""
    parts = tuple(part if part is Ellipsis else _checked(part, about) for part in get_args(hint))
    if get_origin(hint) in (Union, UnionType):
        return Union[parts]  # noqa: UP007  # made here
    if get_origin(hint) is tuple:
        return tuple[parts]  # type: ignore[valid-type]  # made here
    if hint is str and about["pattern"] is not None:
        return Annotated[Text, like(*about["pattern"])]
    strict = {float: Finite, int: Whole, str: Text}.get(hint, hint)
    return Annotated[strict, Field(**about["bounds"])] if about["bounds"] else strict


def _either(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"


_DEFAULT_DISTANCE_MM = 1000.0


class _SerialSection(DriverTable):
    """A device at a serial port."""

    shared_keys: ClassVar[Mapping[str, str]] = {
        "port": 'it, such as "/dev/ttyUSB0", "COM3", "socket://10.0.0.7:4001" or "serial-number:ABC123"',
        "baud": "",
        "identity": "",
    }

    port: Annotated[Text | None, FREE] = default(
        None, '"/dev/ttyUSB0", "COM3", "socket://HOST:PORT" or "serial-number:ABC123" (of its USB adapter)'
    )
    baud: Annotated[Annotated[Whole, Field(ge=300, le=10_000_000)] | None, FREE] = default(
        None, "Bits per second; by default the driver's own"
    )
    identity: Annotated[Text | None, FREE] = default(
        None, "Text that the device's own identification, or its decoder's name, must contain"
    )

    @model_validator(mode="after")
    def _of_a_port(self) -> _SerialSection:
        """A port that is written like a network port or a serial number is one."""
        for beginning, pattern, allowed in (
            ("socket:", r"socket://[^\s/:]+:\d{1,5}", "must be socket://HOST:PORT"),
            ("serial-number:", r"serial-number:\S+", "must be serial-number: and the number itself"),
        ):
            port = self.port or ""
            if port.lower().startswith(beginning) and not re.fullmatch(pattern, port):
                raise mistake("port", port, allowed)
        return self


class MirrorSection(_SerialSection):
    """The scanning mirror and the map from the surface to its angles."""

    distance_mm: Annotated[Positive, DERIVED] = default(
        _DEFAULT_DISTANCE_MM, "Distance from the mirror to the surface's centre, the beam square to it"
    )
    map: Annotated[Matrix | None, DERIVED] = default(
        None, "In place of distance_mm: H of (tan x, tan y, 1) ~ H (x_mm, y_mm, 1)"
    )
    settle_s: Annotated[NonNegative, FREE] = default(0.005, "Time that the beam swings after a move")
    limit_mrad: Annotated[Positive, FREE] = default(
        250.0, "Largest optical angle on either axis", lt=1000 * math.pi / 2
    )
    park_mrad: Annotated[tuple[Finite, Finite], FREE] = default(
        (-240.0, -240.0), "Safe direction, within limit_mrad: off the plate, and where no eye can be"
    )

    @property
    def matrix(self) -> Matrix:
        """The projective map H of ``(tan x, tan y, 1) ~ H (x_mm, y_mm, 1)``."""
        if self.map is not None:
            return self.map
        return ((1 / self.distance_mm, 0.0, 0.0), (0.0, 1 / self.distance_mm, 0.0), (0.0, 0.0, 1.0))

    def plan_values(self) -> dict[str, Any]:
        """The map is hashed as its matrix, wherever it comes from."""
        return super().plan_values() | {"matrix": self.matrix}

    @model_validator(mode="after")
    def _possible(self) -> MirrorSection:
        if self.map is not None:
            if self.distance_mm != _DEFAULT_DISTANCE_MM:
                raise mistake("distance_mm", self.distance_mm, "must be left out where map is given")
            rows = np.array(self.map)
            scale = np.linalg.norm(rows, axis=1)
            if not scale.all() or abs(np.linalg.det(rows / scale[:, np.newaxis])) < 1e-12:
                raise mistake("map", self.map, "must be a matrix that can be inverted")
        if max(map(abs, self.park_mrad)) > self.limit_mrad:
            raise mistake("park_mrad", self.park_mrad, f"must be within limit_mrad = {self.limit_mrad:g}")
        return self


if not TYPE_CHECKING:
    MirrorSection = _with_drivers(MirrorSection, MIRRORS)


AnalogInput = Annotated[Text, like(*ANALOG_INPUT)]


class RecorderSection(DriverTable):
    """The two-channel DAQ: reference (loopback) and response (vibrometer)."""

    reference_range_v: Annotated[Positive, ALWAYS] = default(10.0, "Input range of the loopback")
    response_range_v: Annotated[Positive, ALWAYS] = default(10.0, "Input range of the vibrometer")
    response_ranges_v: Annotated[tuple[Positive, ...] | None, FREE] = default(
        None, "Larger ranges for a position that was over response_range_v; by default all that the device has"
    )
    reference_gain: Annotated[Positive, ALWAYS] = default(1.0, "Volts at the reference input per volt of drive")
    inter_channel_delay_s: Annotated[Finite, ALWAYS] = default(
        5e-6,
        "Delay of the response's sampling after the reference's; from calibrate, or the device",
        ge=-0.001,
        le=0.001,
    )
    pre_roll_s: Annotated[NonNegative, ALWAYS] = default(0.02, "Recorded before the player starts", le=10)
    post_roll_s: Annotated[NonNegative, ALWAYS] = default(
        0.1, "Recorded after the player should have ended; covers its latency", le=10
    )

    @model_validator(mode="before")
    @classmethod
    def _no_trigger(cls, data: Any) -> Any:
        """An empty trigger is none, said outright."""
        return {**data, "trigger": None} if isinstance(data, dict) and data.get("trigger") == "" else data


class VibrometerSection(_SerialSection):
    """The laser vibrometer's calibration: typed in, or read from the device."""

    driver: Annotated[str, FREE] = "fixed"
    sensitivity_m_s_per_v: Annotated[Positive | None, ALWAYS] = default(
        None, "m/s per volt at the DAQ; optional where a port is given, and must then agree with the device"
    )
    latency_s: Annotated[NonNegative, Field(le=0.001)] | None = default(
        None, "Delay of the voltage after the velocity; by default 0, or read from a polytec-ofv5000"
    )

    @model_validator(mode="before")
    @classmethod
    def _fixed(cls, data: Any) -> Any:
        fixed = isinstance(data, dict) and data.get("driver", "fixed") == "fixed"
        return {"sensitivity_m_s_per_v": 0.125, **data} if fixed else data


if not TYPE_CHECKING:
    RecorderSection = _with_drivers(RecorderSection, RECORDERS)
    VibrometerSection = _with_drivers(VibrometerSection, VIBROMETERS)


class ShutterSection(DriverTable):
    """What blocks the laser beam while it rests, and whenever something fails; nothing, if absent."""

    opens_s: Annotated[NonNegative, FREE] = default(0.02, "Time that it takes to open or close", le=10)


if not TYPE_CHECKING:
    ShutterSection = _with_drivers(ShutterSection, SHUTTERS)


Channel = Annotated[Whole, Field(ge=0, le=4095)]


class PlayerSection(DriverTable):
    """The multichannel audio interface that drives the actuators."""

    channels: Annotated[tuple[Channel, ...], ALWAYS] = Field(
        description="Output of each actuator, from 0, in the order of position_mm"
    )
    loopback_channel: Annotated[Channel, ALWAYS] = Field(
        description="Spare output that is wired to the reference input"
    )
    interface_rate_hz: Annotated[Whole, FREE] = default(48_000, "Rate of the audio interface", ge=8_000, le=768_000)
    full_scale_v: Annotated[Positive, ALWAYS] = default(5.0, "Volts at full scale, all outputs")
    channel_full_scale_v: tuple[Positive, ...] | None = default(
        None, "Volts at full scale of each output from 0 to the highest used; from calibrate"
    )
    limit_v: Annotated[Positive, FREE] = default(5.0, "Largest voltage of an actuator, at most full_scale_v")
    limit_rms_v: Annotated[Positive | None, FREE] = default(None, "Largest rms voltage of an actuator over any second")
    coil_resistance_ohm: Annotated[Positive | None, FREE] = default(
        None, "Resistance of an actuator's coil; needed for limit_power_w"
    )
    limit_power_w: Annotated[Positive | None, FREE] = default(
        None, "Largest mean power of a coil over any second; the stricter of it and limit_rms_v counts"
    )

    @property
    def outputs(self) -> int:
        """How many outputs the rig needs: up to the highest that is wired."""
        return 1 + max((*self.channels, self.loopback_channel))

    @property
    def output_full_scale_v(self) -> tuple[float, ...]:
        """Volts at full scale of every output from 0 to the highest that is wired."""
        return self.channel_full_scale_v or (self.full_scale_v,) * self.outputs

    @property
    def largest_v(self) -> float:
        """Largest voltage that may be asked of any actuator: the limit, or what the weakest output can put out."""
        return min(self.limit_v, *(self.output_full_scale_v[channel] for channel in self.channels))

    @property
    def largest_sine_v(self) -> float:
        """Largest peak of a sine or a sweep that any actuator may get for as long as one likes."""
        rms = self.rms_limit
        return self.largest_v if rms is None else min(self.largest_v, 2**0.5 * rms[1])

    @property
    def rms_limit(self) -> tuple[str, float] | None:
        """The stricter limit on the rms over a second, with the key that it comes from; None: any rms."""
        limits = []
        if self.limit_rms_v is not None:
            limits.append(("player.limit_rms_v", self.limit_rms_v))
        if self.limit_power_w is not None and self.coil_resistance_ohm is not None:
            limits.append(("player.limit_power_w", (self.limit_power_w * self.coil_resistance_ohm) ** 0.5))
        return min(limits, key=lambda limit: limit[1], default=None)

    @model_validator(mode="after")
    def _wired_once(self) -> PlayerSection:
        for actuator, channel in enumerate(self.channels):
            if channel in self.channels[:actuator]:
                other = self.channels.index(channel)
                raise mistake(f"channels.[{actuator}]", channel, f"is already the channel of actuator {other}")
        if self.loopback_channel in self.channels:
            other = self.channels.index(self.loopback_channel)
            raise mistake("loopback_channel", self.loopback_channel, f"is already the channel of actuator {other}")
        if self.limit_v > self.full_scale_v:
            raise mistake("limit_v", self.limit_v, f"must be at most full_scale_v = {self.full_scale_v:g}")
        if self.limit_power_w is not None and self.coil_resistance_ohm is None:
            raise mistake("coil_resistance_ohm", None, "is needed in ohms with limit_power_w")
        each = self.channel_full_scale_v
        if each is not None and self.channels and len(each) != self.outputs:
            wanted = f"must have one entry per output from 0 to the highest used, {self.outputs} in all"
            raise mistake("channel_full_scale_v", each, f"{wanted}, has {len(each)}")
        return self


if not TYPE_CHECKING:
    PlayerSection = _with_drivers(PlayerSection, PLAYERS)
