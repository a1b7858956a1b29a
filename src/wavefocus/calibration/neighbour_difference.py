"""Differences of a position's rows from their predictions, and the causes that explain them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from wavefocus.calibration import Complex128Array, Float64Array

EXPLAINED = 0.8
"""A cause is named when it explains this share of the difference."""
LATEST_S = 0.02

Kind = Literal["level", "polarity", "delay", "swapped", "elsewhere", "other"]


@dataclass(frozen=True, slots=True)
class NeighbourDifference:
    """Rows that are not what their neighbours say.

    position: The position.
    actuators: The actuators whose rows differ.
    kind: ``"level"``, ``"polarity"``, ``"delay"``, ``"swapped"`` (the rows are those of each other's or of another
        actuator), ``"elsewhere"`` (all rows are those of another place), or ``"other"``.
    relative: Difference over prediction, L2 norms within the band.
    level_db, delay_s: Of the rows relative to their predictions, where the kind has them.
    other: The actuator whose response it is, where ``"swapped"``.
    place_mm: The place whose response it is, where ``"elsewhere"``.
    whole: Whether all of the position's rows that can be judged differ.
    """

    position: int
    actuators: tuple[int, ...]
    kind: Kind
    relative: float
    level_db: float = 0.0
    delay_s: float = 0.0
    other: int | None = None
    place_mm: tuple[float, float] | None = None
    whole: bool = False

    @property
    def sentence(self) -> str:
        """The difference in words, without the position's number."""
        if self.whole:
            rows = "all responses"
        elif len(self.actuators) > 1:
            rows = "the responses of actuators " + ", ".join(map(str, self.actuators))
        else:
            rows = f"the response of actuator {self.actuators[0]}"
        return f"{rows} {self._what(single=not self.whole and len(self.actuators) == 1)}"

    def _what(self, *, single: bool) -> str:
        verb, its = ("differs", "its prediction") if single else ("differ", "their predictions")
        against = f"{its} from the other positions"
        if self.kind == "level":
            return f"{verb} by {self.level_db:+.1f} dB from {against}"
        if self.kind == "polarity":
            level = f" and {self.level_db:+.1f} dB in level" if abs(self.level_db) >= 0.5 else ""
            return f"{verb} in polarity{level} from {against}"
        if self.kind == "delay":
            return f"{verb} by {1e3 * self.delay_s:+.2f} ms in delay from {against}"
        if self.kind == "swapped":
            if single:
                return f"{'is' if single else 'are'} that of actuator {self.other}"
            return "are swapped"
        if self.kind == "elsewhere" and self.place_mm is not None:
            x, y = self.place_mm
            return f"{'is' if single else 'are'} those of another place, near ({x:.1f}, {y:.1f}) mm"
        return f"{verb} by {100 * self.relative:.0f} % from {against}"


def cause_of(
    values: Complex128Array,
    predicted: Complex128Array,
    typical: Float64Array,
    frequency_hz: Float64Array,
    more: Iterable[tuple[float, dict[str, object]]] = (),
) -> dict[str, object] | None:
    """A level, a polarity or a delay that explains a difference, the same for all rows given, or one more cause.

    Of causes that explain it about as well, the first.
    """
    differs = float((np.square(np.abs(values - predicted)) / typical).sum())
    enough = (1.0 - EXPLAINED) * differs

    def left(model: Complex128Array) -> float:
        return float((np.square(np.abs(values - model)) / typical).sum())

    def factor(model: Complex128Array) -> float:
        weight = float((np.square(np.abs(model)) / typical).sum())
        return float((model.conj() * values / typical).sum().real) / max(weight, 1e-300)

    level = factor(predicted)
    level_db = 20.0 * float(np.log10(max(abs(level), 1e-10)))
    finest_s = 0.01 / frequency_hz[-1]
    delays_s = np.arange(-LATEST_S, LATEST_S + finest_s, finest_s)
    matched = (predicted.conj() * values / typical).reshape(-1, values.shape[-1]).sum(axis=0)
    turned = np.exp(2j * np.pi * np.outer(delays_s, frequency_hz)) @ matched
    delay_s = float(delays_s[int(np.argmax(turned.real))])
    causes: list[tuple[float, dict[str, object]]] = [
        (left(level * predicted), {"kind": "level" if level > 0 else "polarity", "level_db": level_db}),
        (
            left(predicted * np.exp(-2j * np.pi * frequency_hz * delay_s)),
            {"kind": "delay", "delay_s": delay_s},
        ),
        *more,
    ]
    least = min(missed for missed, _ in causes)
    if least > enough:
        return None
    return next(cause for missed, cause in causes if missed <= max(2.0 * least, 0.05 * enough))


def swapped(
    actuator: int, values: Complex128Array, predicted: Complex128Array, typical: Float64Array
) -> tuple[float, dict[str, object]]:
    """The actuator whose prediction a row fits best, and what it misses."""
    left = (np.square(np.abs(values[actuator] - predicted)) / typical[actuator]).sum(axis=1)
    left[actuator] = np.inf
    other = int(np.argmin(np.nan_to_num(left, nan=np.inf)))
    return float(left[other]), {"kind": "swapped", "other": other}


def together(found: list[NeighbourDifference], *, whole: bool) -> list[NeighbourDifference]:
    """Two rows that are each other's become one difference, and all that is nameless another."""
    other_of = {difference.actuators[0]: difference.other for difference in found if difference.kind == "swapped"}
    listed: list[NeighbourDifference] = []
    nameless = [difference for difference in found if difference.kind == "other"]
    for difference in found:
        actuator = difference.actuators[0]
        if difference.other is not None and other_of.get(difference.other) == actuator:
            if actuator < difference.other:
                listed.append(
                    NeighbourDifference(
                        difference.position, (actuator, difference.other), "swapped", difference.relative
                    )
                )
        elif difference.kind != "other":
            listed.append(difference)
    if nameless:
        actuators = tuple(difference.actuators[0] for difference in nameless)
        relative = max(difference.relative for difference in nameless)
        listed.append(
            NeighbourDifference(nameless[0].position, actuators, "other", relative, whole=whole and not listed)
        )
    return listed


def relative_norm(errors: Complex128Array, predicted: Complex128Array) -> float:
    """Norm of errors over that of the predictions."""
    return float(np.linalg.norm(errors) / max(float(np.linalg.norm(predicted)), 1e-300))
