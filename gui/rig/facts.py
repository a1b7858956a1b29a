"""What processes tell, as the Rig tab keeps it: typed, and safe against what is missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RigFacts:
    """An open rig.

    Parameters
    ----------
    name : str
        Of the rig.
    instruments : mapping from role to str
        What they say they are.
    length_mm, width_mm : float
        Of the surface, a stadium.
    actuator_mm : float64 array (actuators, 2)
        Where they are.
    mapped : bool
        Whether the mirror map was measured.
    limit_mrad : float
        Of the mirror.
    level_v, largest_level_v : float
        Peak of a sweep that is safe, and that is allowed.
    band_hz : tuple of float
        Of a sweep.
    """

    name: str
    instruments: Mapping[str, str]
    length_mm: float
    width_mm: float
    actuator_mm: Float64Array
    mapped: bool
    limit_mrad: float
    level_v: float
    largest_level_v: float
    band_hz: tuple[float, float]

    @classmethod
    def told(cls, told: Mapping[str, object]) -> RigFacts:
        """From a ``ready`` event."""
        surface, band = table(told, "surface"), told["band_hz"]
        assert isinstance(band, list)
        return cls(
            name=str(told["name"]),
            instruments={role: str(words) for role, words in table(told, "instruments").items()},
            length_mm=number(surface, "length_mm"),
            width_mm=number(surface, "width_mm"),
            actuator_mm=np.asarray(told["actuator_mm"], np.float64).reshape(-1, 2),
            mapped=bool(told["mapped"]),
            limit_mrad=number(told, "limit_mrad"),
            level_v=number(told, "level_v"),
            largest_level_v=number(told, "largest_level_v"),
            band_hz=(float(band[0]), float(band[1])),
        )


@dataclass(frozen=True, slots=True)
class Spot:
    """Where the beam is; places are None where there is none."""

    x_mm: float | None
    y_mm: float | None
    x_mrad: float | None
    y_mrad: float | None
    parked: bool

    @classmethod
    def told(cls, told: Mapping[str, object]) -> Spot:
        """From a ``mirror`` event."""
        x_mm, y_mm, x_mrad, y_mrad = (maybe(told.get(key)) for key in ("x_mm", "y_mm", "x_mrad", "y_mrad"))
        return cls(x_mm, y_mm, x_mrad, y_mrad, bool(told.get("parked")))

    @property
    def words(self) -> str:
        """For people."""
        if self.x_mrad is None or self.y_mrad is None:
            return "the beam was not moved yet"
        angles = f"({self.x_mrad:.3f}, {self.y_mrad:.3f}) mrad"
        if self.parked:
            return f"parked at {angles}"
        if self.x_mm is None or self.y_mm is None:
            return f"at {angles}, beside the surface"
        return f"at ({self.x_mm:.2f}, {self.y_mm:.2f}) mm, {angles}"


@dataclass(frozen=True, slots=True)
class ChannelLevel:
    """Level of one input, in V."""

    rms_v: float
    peak_v: float
    range_v: float
    over_range: bool

    @classmethod
    def told(cls, told: Mapping[str, object]) -> ChannelLevel:
        """From one channel of a ``level`` event."""
        return cls(number(told, "rms_v"), number(told, "peak_v"), number(told, "range_v"), bool(told.get("over_range")))


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """A sweep as it was heard; spectra in dB re 1 V / sqrt(Hz)."""

    actuator: int
    level_v: float
    band_hz: tuple[float, float]
    sample_rate_hz: float
    reference_v: Float64Array
    response_v: Float64Array
    frequency_hz: Float64Array
    response_db: Float64Array
    noise_db: Float64Array
    response: ChannelLevel
    reference: ChannelLevel
    figures: Mapping[str, object] | None
    trouble: str

    @classmethod
    def told(cls, told: Mapping[str, object]) -> Sweep:
        """From a ``sweep`` event."""
        level = table(told, "level")
        figures = told.get("figures")
        return cls(
            actuator=int(number(told, "actuator")),
            level_v=number(told, "level_v"),
            band_hz=(number(told, "start_hz"), number(told, "stop_hz")),
            sample_rate_hz=number(told, "sample_rate_hz"),
            reference_v=np.asarray(told["reference_v"], np.float64),
            response_v=np.asarray(told["response_v"], np.float64),
            frequency_hz=np.asarray(told["frequency_hz"], np.float64),
            response_db=np.asarray(told["response_db"], np.float64),
            noise_db=np.asarray(told["noise_db"], np.float64),
            response=ChannelLevel.told(table(level, "response")),
            reference=ChannelLevel.told(table(level, "reference")),
            figures=figures if isinstance(figures, dict) else None,
            trouble=str(told.get("trouble") or ""),
        )

    @property
    def defects(self) -> list[str]:
        """What is wrong with it, in sentences."""
        named = self.figures.get("defects") if self.figures is not None else None
        found = [str(one["sentence"]) for one in named] if isinstance(named, list) else []
        return [*([self.trouble] if self.trouble else []), *found]

    @property
    def words(self) -> str:
        """Its figures for people."""
        told = [f"actuator {self.actuator} at {self.level_v:.3g} V", f"response {volts(self.response.peak_v)} peak"]
        if self.figures is not None:
            for key, words in (("snr_db", "signal {:.0f} dB above noise"), ("residual_db", "{:.0f} dB unexplained")):
                if (value := maybe(self.figures.get(key))) is not None:
                    told.append(words.format(value))
            if (latency_s := maybe(self.figures.get("latency_s"))) is not None:
                told.append(f"latency {1e3 * latency_s:.1f} ms")
            if (ppm := maybe(self.figures.get("clock_ppm"))) is not None:
                told.append(f"clocks {ppm:+.0f} ppm apart")
        return "; ".join(told)


def volts(value_v: float) -> str:
    """Volts with a prefix that people use."""
    size = abs(value_v)
    if size >= 1.0:
        return f"{value_v:.3g} V"
    return f"{1e3 * value_v:.3g} mV" if size >= 1e-3 else f"{1e6 * value_v:.3g} µV"


def number(told: Mapping[str, object], key: str) -> float:
    """A number that must be there."""
    value = told[key]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{key} is {value!r}, no number")
    return float(value)


def maybe(value: object) -> float | None:
    """A number, None where there is none."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def table(told: Mapping[str, object], key: str) -> Mapping[str, object]:
    """A table that must be there."""
    value = told[key]
    if not isinstance(value, dict):
        raise TypeError(f"{key} is {value!r}, no table")
    return value
