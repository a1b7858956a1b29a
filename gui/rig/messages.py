"""Messages of ``operate``, ``calibrate`` and ``doctor`` as the Rig tab uses them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from config.rig import Surface
from gui.surface.surface import surface_from

Float64Array = NDArray[np.float64]
Pair = tuple[float, float]
Record = Mapping[str, object]

# Actions of a finding, and the text of the button; {on} is the subject.
_BUTTON_TEXTS = {
    "calibrate": "Calibrate {on}…",
    "edit-rig": "Open the rig file",
    "open-folder": "Open the folder",
    "reset-usb": "Reset its USB…",
    "run": "Copy the command",
    "test-message": "Send a test",
}


@dataclass(frozen=True, slots=True, eq=False)
class RigFacts:
    """An open rig, from a ``ready`` message.

    Parameters
    ----------
    instruments : mapping from role to str
        Identification of each instrument.
    surface : Surface
        Its kind and size.
    actuator_mm : float64 array (actuators, 2)
        Positions of the actuators.
    mapped : bool
        Whether the mirror map was measured.
    level_v, largest_level_v : float
        Default and largest peak of a sweep.
    band_hz : tuple of float
        Default band of a sweep.
    """

    instruments: Mapping[str, str]
    surface: Surface
    actuator_mm: Float64Array
    mapped: bool
    level_v: float
    largest_level_v: float
    band_hz: Pair

    @classmethod
    def from_record(cls, record: Record) -> RigFacts:
        band_hz = pair(record.get("band_hz"))
        assert band_hz is not None
        return cls(
            instruments={role: str(name) for role, name in table(record, "instruments").items()},
            surface=surface_from(record.get("surface")),
            actuator_mm=np.asarray(record["actuator_mm"], np.float64).reshape(-1, 2),
            mapped=bool(record["mapped"]),
            level_v=number(record, "level_v"),
            largest_level_v=number(record, "largest_level_v"),
            band_hz=band_hz,
        )


@dataclass(frozen=True, slots=True)
class Spot:
    """Place of the laser beam, from a ``mirror`` message; None where it has none."""

    place_mm: Pair | None = None
    angle_mrad: Pair | None = None
    parked: bool = False

    @classmethod
    def from_record(cls, record: Record) -> Spot:
        x_mm, y_mm, x_mrad, y_mrad = (record.get(key) for key in ("x_mm", "y_mm", "x_mrad", "y_mrad"))
        return cls(pair([x_mm, y_mm]), pair([x_mrad, y_mrad]), bool(record.get("parked")))

    @property
    def text(self) -> str:
        if self.angle_mrad is None:
            return "not moved yet"
        angles = "({:.3f}, {:.3f}) mrad".format(*self.angle_mrad)
        if self.parked:
            return f"parked at {angles}"
        if self.place_mm is None:
            return f"at {angles}, outside the surface"
        return "at ({:.2f}, {:.2f}) mm, ".format(*self.place_mm) + angles


@dataclass(frozen=True, slots=True)
class ChannelLevel:
    """Level of one input, in V."""

    rms_v: float
    peak_v: float
    range_v: float
    over_range: bool

    @classmethod
    def from_record(cls, record: Record) -> ChannelLevel:
        rms_v, peak_v, range_v = (number(record, key) for key in ("rms_v", "peak_v", "range_v"))
        return cls(rms_v, peak_v, range_v, bool(record.get("over_range")))


@dataclass(frozen=True, slots=True)
class Levels:
    """Levels of both inputs, and the vibrometer's signal level from 0 to 1 where it has one."""

    reference: ChannelLevel
    response: ChannelLevel
    signal: float | None = None

    @classmethod
    def from_record(cls, record: Record) -> Levels:
        reference, response = (ChannelLevel.from_record(table(record, key)) for key in ("reference", "response"))
        return cls(reference, response, optional_number(record.get("light")))


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """A recorded sweep; spectra in dB re 1 V / sqrt(Hz)."""

    actuator: int
    level_v: float
    band_hz: Pair
    sample_rate_hz: float
    reference_v: Float64Array
    response_v: Float64Array
    frequency_hz: Float64Array
    response_db: Float64Array
    noise_db: Float64Array
    response_peak_v: float
    figures: Record
    defects: list[str]

    @classmethod
    def from_record(cls, record: Record) -> Sweep:
        figures, trouble = record.get("figures"), record.get("trouble")
        figures = figures if isinstance(figures, dict) else {}
        found = [str(one["sentence"]) for one in figures.get("defects", [])]
        return cls(
            actuator=int(number(record, "actuator")),
            level_v=number(record, "level_v"),
            band_hz=(number(record, "start_hz"), number(record, "stop_hz")),
            sample_rate_hz=number(record, "sample_rate_hz"),
            reference_v=np.asarray(record["reference_v"], np.float64),
            response_v=np.asarray(record["response_v"], np.float64),
            frequency_hz=np.asarray(record["frequency_hz"], np.float64),
            response_db=np.asarray(record["response_db"], np.float64),
            noise_db=np.asarray(record["noise_db"], np.float64),
            response_peak_v=number(table(table(record, "level"), "response"), "peak_v"),
            figures=figures,
            defects=[str(trouble), *found] if trouble else found,
        )

    @property
    def text(self) -> str:
        parts = [f"actuator {self.actuator} at {self.level_v:.3g} V", f"response {volts(self.response_peak_v)} peak"]
        for key, factor, template in (
            ("snr_db", 1.0, "signal {:.0f} dB above noise"),
            ("residual_db", 1.0, "{:.0f} dB unexplained"),
            ("latency_s", 1e3, "latency {:.1f} ms"),
            ("clock_ppm", 1.0, "clocks {:+.0f} ppm apart"),
        ):
            value = optional_number(self.figures.get(key))
            if value is not None:
                parts.append(template.format(factor * value))
        return "; ".join(parts)


@dataclass(frozen=True, slots=True)
class Question:
    """Question of a calibration: ``"jog"``, ``"map"``, ``"connect"`` or ``"again"``, with its facts."""

    kind: str
    record: Record

    def pair(self, key: str) -> Pair | None:
        return pair(self.record.get(key))

    def pairs(self, key: str) -> list[Pair]:
        return pairs(self.record.get(key))

    def number(self, key: str) -> float | None:
        return optional_number(self.record.get(key))

    def text(self, key: str) -> str:
        return str(self.record.get(key) or "")


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding of an examination; `action` can be done by the window, `on` is its subject."""

    instrument: str
    check: str
    verdict: str
    what: str
    remedy: str
    action: str
    on: str

    @classmethod
    def from_record(cls, record: Record) -> Finding:
        instrument, check, verdict, what, remedy = (
            str(record.get(key) or "") for key in ("instrument", "check", "verdict", "what", "remedy")
        )
        act = record.get("act")
        action, on = (str(act.get(key) or "") for key in ("do", "on")) if isinstance(act, dict) else ("", "")
        action = action if action in _BUTTON_TEXTS else ""  # an unknown one is a remedy in words
        return cls(instrument, check, verdict, what, remedy, action, on)

    @property
    def bad(self) -> bool:
        return self.verdict in ("fail", "warn")

    @property
    def button(self) -> tuple[str, str] | None:
        """Action and text of its button; None where there is nothing to do."""
        if self.action:
            return self.action, _BUTTON_TEXTS[self.action].format(on=self.on).replace(" …", "…")
        return ("again", "Check again") if self.bad else None


def volts(value_v: float) -> str:
    """Volts with a prefix."""
    size = abs(value_v)
    if size >= 1.0:
        return f"{value_v:.3g} V"
    return f"{1e3 * value_v:.3g} mV" if size >= 1e-3 else f"{1e6 * value_v:.3g} µV"


def number(record: Record, key: str) -> float:
    """A number that must be there."""
    value = optional_number(record[key])
    if value is None:
        raise TypeError(f"{key} is {record[key]!r}, not a number")
    return value


def optional_number(value: object) -> float | None:
    """A number, None where there is none."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def pair(value: object) -> Pair | None:
    """Two numbers, None where there are none."""
    if not isinstance(value, list) or len(value) != 2:
        return None
    first, second = (optional_number(one) for one in value)
    return None if first is None or second is None else (first, second)


def pairs(value: object) -> list[Pair]:
    """All pairs of numbers in a list."""
    return [found for one in value if (found := pair(one)) is not None] if isinstance(value, list) else []


def table(record: Record, key: str) -> Record:
    """A table that must be there."""
    value = record[key]
    if not isinstance(value, dict):
        raise TypeError(f"{key} is {value!r}, not a table")
    return value
