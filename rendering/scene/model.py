"""A scene: sources that emit signals along paths, and the bounds of their drives."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from config.scene import Output, Regularisation
from rendering.scene.paths import Path, Point
from rendering.scene.signals import Signal
from storage.errors import InputError

Emission = Literal["continuous", "per_point"]


@dataclass(frozen=True, slots=True)
class Source:
    """One source that emits `signal` along `path`.

    signal: Its signal, peak 1 before `amplitude`.
    start_s: Start in scene time, >= 0: the drive array has no room before the lead-in.
    speed_mm_s: Speed, > 0 on a path that moves; ignored for a point.
    step_mm: Path sample distance d, > 0 on a path that moves.
    amplitude: In the bank's response unit when the scene normalises.
    emission, {"continuous", "per_point"}: The signal runs on along the path, or every path point emits all of it anew.

    Raises InputError where a value is out of range.
    """

    path: Path
    signal: Signal
    start_s: float = 0.0
    speed_mm_s: float = 0.0
    step_mm: float = 0.0
    amplitude: float = 1.0
    emission: Emission = "continuous"

    def __post_init__(self) -> None:
        _check(self.start_s >= 0, "start_s", self.start_s, ", 0 or above")
        _check(True, "amplitude", self.amplitude, "")
        if self.emission not in ("continuous", "per_point"):
            raise InputError(f"emission is {self.emission!r}; allowed are 'continuous' and 'per_point'")
        if isinstance(self.path, Point):
            return
        for name in ("speed_mm_s", "step_mm"):
            value = getattr(self, name)
            _check(value >= 0, name, value, " above 0")


@dataclass(frozen=True, slots=True)
class Scene:
    """Sources that sound together.

    sources: At least one; their drives add.
    regularisation: Saturation and normalisation, the same for all sources.
    output: Interpolation and limit.
    allow_large: It may be larger than the limits of `rendering.scene.size`.
    """

    name: str
    sources: tuple[Source, ...]
    regularisation: Regularisation = field(default_factory=Regularisation)
    output: Output = field(default_factory=Output)
    allow_large: bool = False

    def __post_init__(self) -> None:
        if not self.sources:
            raise InputError("the scene has no source; at least one [[source]] is needed")


def _check(allowed: bool, name: str, value: float | None, words: str) -> None:
    if not allowed or not math.isfinite(value or 0.0):
        raise InputError(f"{name} is {value}; it must be a finite number{words}")
