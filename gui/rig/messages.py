"""Messages of ``operate``, ``calibrate`` and ``doctor`` as the Rig tab shows them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from config.messages.doctor import Action, Finding
from config.messages.operate import MirrorMoved, SweepTaken

Pair = tuple[float, float]
Record = Mapping[str, object]

# Actions of a finding, and the text of the button; {on} is the subject.
_BUTTON_TEXTS: dict[Action, str] = {
    "calibrate": "Calibrate {on}…",
    "edit-rig": "Open the rig file",
    "open-folder": "Open the folder",
    "reset-usb": "Reset its USB…",
    "run": "Copy the command",
    "test-message": "Send a test",
}


@dataclass(frozen=True, slots=True)
class Spot:
    """Place of the laser beam, from a ``mirror`` message; None where it has none."""

    place_mm: Pair | None = None
    angle_mrad: Pair | None = None
    parked: bool = False

    @classmethod
    def of(cls, moved: MirrorMoved) -> Spot:
        return cls(_both(moved.x_mm, moved.y_mm), _both(moved.x_mrad, moved.y_mrad), moved.parked)

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


def sweep_defects(sweep: SweepTaken) -> list[str]:
    """Why a sweep has no figures, and the defects of its record."""
    found = [] if sweep.figures is None else [defect.sentence for defect in sweep.figures.defects]
    return [sweep.trouble, *found] if sweep.trouble else found


def sweep_text(sweep: SweepTaken) -> str:
    """Figures of a sweep in one line."""
    parts = [
        f"actuator {sweep.actuator} at {sweep.level_v:.3g} V",
        f"response {volts(sweep.level.response.peak_v)} peak",
    ]
    if sweep.figures is not None:
        for value, template in (
            (sweep.figures.snr_db, "signal {:.0f} dB above noise"),
            (sweep.figures.residual_db, "{:.0f} dB unexplained"),
            (1e3 * sweep.figures.latency_s, "latency {:.1f} ms"),
            (sweep.figures.clock_ppm, "clocks {:+.0f} ppm apart"),
        ):
            if math.isfinite(value):
                parts.append(template.format(value))
    return "; ".join(parts)


def button_of(finding: Finding) -> tuple[str, str] | None:
    """Action and text of a finding's button; None where there is nothing to do."""
    if finding.act is not None:
        return finding.act.do, _BUTTON_TEXTS[finding.act.do].format(on=finding.act.on).replace(" …", "…")
    return ("again", "Check again") if is_bad(finding) else None


def is_bad(finding: Finding) -> bool:
    """Whether a finding needs attention."""
    return finding.verdict in ("fail", "warn")


def volts(value_v: float) -> str:
    """Volts with a prefix."""
    size = abs(value_v)
    if size >= 1.0:
        return f"{value_v:.3g} V"
    return f"{1e3 * value_v:.3g} mV" if size >= 1e-3 else f"{1e6 * value_v:.3g} µV"


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


def _both(x: float | None, y: float | None) -> Pair | None:
    return None if x is None or y is None else (x, y)
