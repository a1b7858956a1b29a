"""Conditions that are watched while a campaign measures, and the ranges that they must stay in."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

Sensor = Callable[[], float]
"""Returns a value between two records, in the unit of its range, or raises InstrumentError."""


@dataclass(frozen=True, slots=True)
class AllowedRange:
    """Where a condition must stay.

    words: What it is, for people: ``"reference level"``.
    unit: Of all limits.
    leaves_below, leaves_above: Beyond these measuring is suspended; infinite where there is no limit.
    returns_above, returns_below: Within these it may go on: inside the limits above, so that nothing flutters.
    settle_s: How long it must have been back before measuring goes on.
    """

    words: str
    unit: str
    leaves_below: float = -math.inf
    leaves_above: float = math.inf
    returns_above: float = -math.inf
    returns_below: float = math.inf
    settle_s: float = 0.0

    def left(self, value: float) -> str:
        """Why this value is no good, in words; empty where it is."""
        if value < self.leaves_below:
            return f"{self.words} {value:.3g} {self.unit} is below {self.leaves_below:g} {self.unit}"
        if value > self.leaves_above:
            return f"{self.words} {value:.3g} {self.unit} is above {self.leaves_above:g} {self.unit}"
        return ""

    def is_back(self, value: float) -> bool:
        """Whether this value lets measuring go on."""
        return self.returns_above <= value <= self.returns_below


@dataclass(frozen=True, slots=True)
class Watch:
    """What is watched in a campaign.

    bands: Ranges by condition: ``"reference"`` (energy of the reference against what the drive makes, in dB) and
        ``"noise"`` (of the response above the sweep's band, as rms of white noise, in V) come from records; any other
        name needs a sensor.
    sensors: What is asked after each position.
    probe_every_s: How often it is looked whether all is well again, > 0.
    give_up_after_s: Longest suspension.
    """

    bands: Mapping[str, AllowedRange]
    sensors: Mapping[str, Sensor]
    probe_every_s: float = 30.0
    give_up_after_s: float = 7200.0


NOTHING_WATCHED = Watch({}, {})
