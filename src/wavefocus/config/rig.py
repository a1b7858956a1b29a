"""The rig file: surface, actuators, instruments and how they are looked after."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavefocus.config.calibration import CalibrationRecord, with_calibration
from wavefocus.config.emulation import Emulation
from wavefocus.config.fields import (
    ALWAYS,
    DERIVED,
    FREE,
    Finite,
    NonNegative,
    PointMm,
    Positive,
    Table,
    Text,
    Whole,
    default,
    mistake,
)
from wavefocus.config.outline import Kind, Outline
from wavefocus.config.rig_instruments import (
    AnalogInput,
    MirrorSection,
    PlayerSection,
    RecorderSection,
    ShutterSection,
    VibrometerSection,
)


class _CalibrationSection(Table):
    """Which calibration file holds, and for how long it is trusted without a word."""

    file: Text | None = default(None, "File of wavefocus calibrate; what it has measured wins")
    stale_after_days: Positive = default(90.0, "Age from which a calibration is warned of")
    measured: CalibrationRecord | None = None
    """What the file holds; filled in on loading, so that a bank needs no other file."""


class _RecoverySection(Table):
    """How long a lost instrument is waited for, and when a call to one counts as hung."""

    give_up_after_s: NonNegative = default(
        600.0, "Longest wait for a lost instrument; then the campaign ends", le=7 * 86_400
    )
    hung_after_s: Positive = default(
        20.0, "Time beyond the operation's own after which a call counts as hung, its instrument as lost", le=3600
    )


class _UsbSection(Table):
    """The USB device of a role."""

    role: Literal["mirror", "recorder", "player", "vibrometer"] = Field(description="Role of the device")
    vendor_id: Annotated[Whole, Field(ge=0, le=0xFFFF)] = Field(description="Vendor")
    product_id: Annotated[Whole, Field(ge=0, le=0xFFFF)] = Field(description="Product")
    serial_number: Text | None = default(None, "Serial number; needed where two devices have the same ids")


About = Literal["finished", "failed", "stopped", "suspended", "drift"]
_ABOUT: tuple[About, ...] = ("finished", "failed", "suspended", "drift")


class MessagesSection(Table):
    """Addresses, as apprise has them, and the events they receive.

    The addresses are secrets: they are left out wherever a rig is written, so a bank never holds them.
    """

    urls: tuple[Text, ...] = default(
        (),
        "Addresses as apprise has them (pip install 'wavefocus[notify]'); secrets, in no bank or log",
        max_length=64,
        exclude=True,
        repr=False,
    )
    about: tuple[About, ...] = default(_ABOUT, 'Events that send a message; also "stopped"')
    suspended_after_min: NonNegative = default(
        10.0, "Wait, suspended or for a lost instrument, after which a message is sent", le=10_000
    )
    alive_url: Text | None = default(
        None,
        "Address that is asked for each minute while a run is on, so that its service raises the alarm when "
        "all is silent; a secret, in no bank or log",
        exclude=True,
        repr=False,
    )
    alive_file: Text | None = default(
        None, "File that is touched each minute while a run is on, relative to the rig file"
    )


class BandSection(Table):
    """Where a value must stay, and within which thresholds it is back."""

    leaves_below: Finite | None = default(
        None, "Below this the condition has left its band; a band needs leaves_below or leaves_above"
    )
    leaves_above: Finite | None = default(None, "Above this the condition has left its band")
    returns_above: Finite | None = default(None, "Above this it is back; by default a tenth inside leaves_below")
    returns_below: Finite | None = default(None, "Below this it is back; by default a tenth inside leaves_above")
    settle_s: NonNegative = default(60.0, "Time for which it must have been back", le=86_400)

    @model_validator(mode="before")
    @classmethod
    def _thresholds(cls, data: Any) -> Any:
        """Fill in the inner thresholds, so that the validated rig says them outright."""
        if not isinstance(data, dict):
            return data
        data = dict(data)
        for leaves, returns, inwards in (
            ("leaves_below", "returns_above", 1.0),
            ("leaves_above", "returns_below", -1.0),
        ):
            limit = data.get(leaves)
            if isinstance(limit, int | float) and not isinstance(limit, bool) and data.get(returns) is None:
                data[returns] = limit + inwards * 0.1 * abs(limit)
        return data

    @model_validator(mode="after")
    def _hysteresis(self) -> BandSection:
        if self.leaves_below is None and self.leaves_above is None:
            raise mistake("leaves_below", None, "is needed, or leaves_above, or both")
        edges = (self.leaves_below, self.returns_above, self.returns_below, self.leaves_above)
        names = ("leaves_below", "returns_above", "returns_below", "leaves_above")
        known = [(name, edge) for name, edge in zip(names, edges, strict=True) if edge is not None]
        for (lower_name, lower), (name, edge) in pairwise(known):
            if edge < lower:
                raise mistake(name, edge, f"must be at least {lower_name} = {lower:g}")
        return self


class RoomSection(BandSection):
    """Room temperature: a transmitter's voltage at an input of the recorder's box."""

    input: AnalogInput = default("ai2", "Input of the recorder's box that the transmitter is wired to")
    celsius_per_v: Finite = default(100.0, "Scale of the transmitter")
    celsius_at_0_v: Finite = default(0.0, "Temperature at 0 V, in degrees Celsius")


class _WatchSection(Table):
    """What is watched while a campaign is under way; nothing, if absent."""

    probe_every_s: Positive = default(30.0, "Interval of the checks whether all conditions are back", le=86_400)
    give_up_after_s: NonNegative = default(
        7200.0, "Longest suspension; then the campaign ends with exit 3", le=7 * 86_400
    )
    reference: BandSection | None = default(
        None, "Band: energy of the loopback relative to the drive's, in dB; of the record farthest out of it"
    )
    noise: BandSection | None = default(
        None, "Band: response above 1.5 times the sweep's end, as rms of white noise in V"
    )
    light: BandSection | None = default(
        None, "Band: signal level of a Polytec controller, 0 to 1; read after each position"
    )
    room: RoomSection | None = default(None, "Band: room temperature in degrees Celsius; read after each position")


_DEFAULT_ACTUATORS = 20


class _RigSection(Table):
    """What the rig is called."""

    name: Text = default("virtual", "Name for messages and reports")


class Surface(Table):
    """The outline of the plate, its length along x; all but a polygon are centred on the origin."""

    kind: Annotated[Kind, ALWAYS] = default("stadium", "A stadium is a rectangle with a half disk at either end")
    length_mm: Annotated[Positive, ALWAYS] = default(250.0, "Length along x, or diameter of a disk", le=100_000)
    width_mm: Annotated[Positive, ALWAYS] = default(150.0, "Width along y; of a stadium at most length_mm", le=100_000)
    corners_mm: Annotated[tuple[PointMm, ...], Field(min_length=3, max_length=1024)] | None = default(
        None, "[x, y] of the corners of a polygon, anticlockwise; length and width follow from them"
    )

    @property
    def outline(self) -> Outline:
        """The curve itself."""
        return Outline.of(self.kind, self.length_mm, self.width_mm, self.corners_mm)

    def inset(self, distance_mm: float) -> Outline:
        """The curve moved inwards; of a polygon, whose actuators are never placed by default, the curve itself."""
        twice_mm = 2 * distance_mm
        return Outline.of(self.kind, self.length_mm - twice_mm, self.width_mm - twice_mm, self.corners_mm)

    @model_validator(mode="before")
    @classmethod
    def _sides_that_follow(cls, data: Any) -> Any:
        """A polygon is twice as long and wide as its farthest corners are away; a disk is as wide as long."""
        if not isinstance(data, dict):
            return data
        try:
            if data.get("kind") == "disk":
                return {"width_mm": data.get("length_mm", 250.0), "length_mm": 250.0, **data}
            if data.get("kind") == "polygon" and "corners_mm" in data:
                far = 2 * np.abs(np.array(data["corners_mm"], dtype=np.float64).reshape(-1, 2)).max(axis=0)
                return {"length_mm": float(far[0]), "width_mm": float(far[1]), **data}
        except (TypeError, ValueError):  # the fields themselves say what is wrong
            pass
        return data

    @model_validator(mode="after")
    def _a_curve(self) -> Surface:
        if self.kind == "stadium" and self.width_mm > self.length_mm:
            raise mistake("width_mm", self.width_mm, f"must be at most length_mm = {self.length_mm:g}")
        if self.kind == "disk" and self.width_mm != self.length_mm:
            raise mistake("width_mm", self.width_mm, f"must be length_mm = {self.length_mm:g}, the disk's diameter")
        if (self.kind == "polygon") != (self.corners_mm is not None):
            raise mistake("corners_mm", self.corners_mm, 'must be given where kind is "polygon", and only there')
        try:
            self.outline  # noqa: B018 - made to see whether it is a curve
        except ValueError as error:
            raise mistake("corners_mm", "...", f"must be the corners of a polygon, anticlockwise: {error}") from None
        return self


class Actuators(Table):
    """Where the actuators touch the plate; their order is the bank's."""

    position_mm: Annotated[tuple[PointMm, ...], Field(min_length=1, max_length=1024), DERIVED] = Field(
        description="[x, y] of each actuator, on the surface; their order is the bank's"
    )


class RigConfig(Table):
    """A validated rig file; with no argument, the built-in virtual rig."""

    rig: Annotated[_RigSection, FREE] = _RigSection()
    surface: Surface = Surface()
    actuators: Actuators
    mirror: MirrorSection = MirrorSection()
    recorder: RecorderSection = RecorderSection()
    player: PlayerSection
    vibrometer: VibrometerSection = VibrometerSection()
    shutter: Annotated[ShutterSection | None, FREE] = None
    recovery: Annotated[_RecoverySection, FREE] = _RecoverySection()
    watch: Annotated[_WatchSection, FREE] = _WatchSection()
    messages: Annotated[MessagesSection, FREE] = MessagesSection()
    calibration: Annotated[_CalibrationSection, FREE] = _CalibrationSection()
    usb: Annotated[tuple[_UsbSection, ...], Field(max_length=64), FREE] = ()
    emulation: Annotated[Emulation, FREE] = Emulation()

    @property
    def actuator_mm(self) -> NDArray[np.float64]:
        """Actuator positions in millimetres, shape (actuators, 2)."""
        return np.array(self.actuators.position_mm, dtype=np.float64)

    @property
    def safe_amplitude_v(self) -> float:
        """A peak in V well below the limits of volts and of rms, and below the ends of the recorder's ranges."""
        recorder = self.recorder
        half_range_v = min(recorder.reference_range_v / recorder.reference_gain, recorder.response_range_v) / 2
        # An output that puts out four times what the rig believes is still within the limit.
        return min(1.0, 0.25 * self.player.largest_sine_v, half_range_v)

    @property
    def is_virtual(self) -> bool:
        """Whether every instrument is virtual."""
        return self.mirror.driver == "virtual"  # validation has seen to it that the others are like it

    @model_validator(mode="before")
    @classmethod
    def _defaults_that_depend(cls, data: Any) -> Any:
        """Fill in what follows from other tables, so that the validated rig says everything outright."""
        if not isinstance(data, dict):
            return data
        data = dict(data)
        actuators, player = data.setdefault("actuators", {}), data.setdefault("player", {})
        if isinstance(actuators, dict) and "position_mm" not in actuators:
            data["actuators"] = {**actuators, "position_mm": _default_actuators(data.get("surface", {}))}
        if isinstance(player, dict):
            position_mm = data["actuators"].get("position_mm") if isinstance(data["actuators"], dict) else None
            count = len(position_mm) if isinstance(position_mm, list | tuple) else _DEFAULT_ACTUATORS
            player = {"channels": list(range(count)), **player}
            if isinstance(player["channels"], list | tuple):
                player.setdefault("loopback_channel", len(player["channels"]))
            data["player"] = player
        return with_calibration(data)

    @model_validator(mode="after")
    def _fits_together(self) -> RigConfig:
        self._check_of_one_kind()
        surface, points = self.surface, self.actuators.position_mm
        outside = np.flatnonzero(~surface.outline.contains(points))
        if len(outside):
            size = f"{surface.length_mm:g} x {surface.width_mm:g} mm"
            first = int(outside[0])
            key = f"actuators.position_mm.[{first}]"
            raise mistake(key, points[first], f"must be on the surface of {size} about the origin")
        for index, point in enumerate(points):
            if point in points[:index]:
                key = f"actuators.position_mm.[{index}]"
                raise mistake(key, point, f"is already the place of actuator {points.index(point)}")
        if len(self.player.channels) != len(points):
            allowed = f"must have one entry per actuator, {len(points)} in all, has {len(self.player.channels)}"
            raise mistake("player.channels", self.player.channels, allowed)
        for key in ("dead_actuators", "weak_actuators", "reversed_actuators"):
            for index, actuator in enumerate(getattr(self.emulation, key)):
                if actuator >= len(points):
                    allowed = f"must be below {len(points)}, the number of actuators"
                    raise mistake(f"emulation.{key}.[{index}]", actuator, allowed)
        outputs = self.player.outputs
        pairs = {"reversed_outputs": [(output,) for output in self.emulation.reversed_outputs]}
        for key, named in {**pairs, "swapped_outputs": self.emulation.swapped_outputs}.items():
            for index, of_entry in enumerate(named):
                if max(of_entry) >= outputs:
                    allowed = f"must be below {outputs}, the number of outputs"
                    raise mistake(f"emulation.{key}.[{index}]", max(of_entry), allowed)
        for key in ("output_gains_db", "output_delays_s"):
            if len(values := getattr(self.emulation, key)) > outputs:
                raise mistake(f"emulation.{key}", values, f"must have at most {outputs} entries, one for each output")
        return self

    def _check_of_one_kind(self) -> None:
        """Instruments are all virtual or all real."""
        one_world = "a rig's instruments are all virtual or all real"
        for name in ("recorder", "player", "shutter"):
            driver = getattr(getattr(self, name), "driver", self.mirror.driver)  # a shutter may be absent
            if (driver == "virtual") != self.is_virtual:
                raise mistake(f"{name}.driver", driver, f'{one_world}, and mirror.driver is "{self.mirror.driver}"')
        if self.is_virtual and self.vibrometer.driver != "fixed":
            raise mistake("vibrometer.driver", self.vibrometer.driver, f"{one_world}, and these are virtual")
        if self.watch.light is not None and self.vibrometer.port is None and not self.is_virtual:
            raise mistake("watch.light", "...", f"needs a vibrometer that reports it, not {self.vibrometer.driver!r}")


def _default_actuators(surface: Any) -> list[list[float]]:
    """Twenty actuators on the rim, to the micrometre, so that a file can hold exactly the same numbers."""
    try:
        size = Surface.model_validate(surface)
    except ValueError:  # reported at the surface itself; any place will do here
        size = Surface()
    if size.kind == "polygon":
        raise mistake("actuators.position_mm", "nothing", "must be given for a polygon, which has no default places")
    rim = size.inset(min(6.0, size.width_mm / 4))
    rim_mm = rim.at(np.arange(_DEFAULT_ACTUATORS) * rim.perimeter_mm / _DEFAULT_ACTUATORS)
    return [[float(x_mm), float(y_mm)] for x_mm, y_mm in np.round(rim_mm, 3) + 0.0]


def default_rig() -> RigConfig:
    """The rig that ``rig = "virtual"`` stands for."""
    return RigConfig.model_validate({})
