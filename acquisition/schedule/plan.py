"""The plan: everything that a campaign will do, as data that dry run, engine and resume all walk."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from acquisition.measuring.record import Rolls, record_samples
from acquisition.quality.limits import DriftLimits, QualityLimits
from calibration.excitation.sweeps import Excitation, StaggeredSignal
from drivers.protocols import Float64Array

# Time of a mirror move, of starting a task and of a commit, for the estimate before a run.
POSITION_OVERHEAD_S = 0.05
GEL_SPEED_M_S = 4.8
"""Waves of a gel plate as in the paper: group velocity about 4.8 m/s."""
# On the virtual rig, up to 500 Hz and 4.8 m/s: all positions are judged at 7 mm, 77 % at 10 mm, 7 % at 12 mm.
COARSE_WAVELENGTHS = 1.1
# Actuators that sound together where all of them do not pay.
GROUP = 5


@dataclass(frozen=True, slots=True)
class Plan:
    """A campaign: which positions, in which order, with what excitation.

    position_mm, float64 (positions, 2): The grid, in the bank's order.
    actuator_mm, float64 (actuators, 2): Where the actuators are.
    order, int64 (positions,): Bank rows in the order of measurement.
    excitation: What plays in each record where actuators sound one after the other.
    taps: Length L of the Green's functions.
    sha256: Hash of all that a resume must not change.
    quality: When a position is good enough.
    staggered: What plays instead where several actuators sound at once.
    drift: How often the sentinel position is measured again, and how far it may drift.
    """

    position_mm: Float64Array
    actuator_mm: Float64Array
    order: NDArray[np.int64]
    excitation: Excitation
    taps: int
    sha256: str
    quality: QualityLimits = field(default_factory=QualityLimits)
    staggered: StaggeredSignal | None = None
    drift: DriftLimits = field(default_factory=DriftLimits)

    @property
    def positions(self) -> int:
        """Number of grid positions."""
        return len(self.position_mm)

    @property
    def actuators(self) -> int:
        """Number of actuators."""
        return len(self.actuator_mm)

    @property
    def records(self) -> int:
        """Records of a position."""
        return self.actuators if self.staggered is None else self.staggered.groups

    def to_do(self, status: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Bank rows still to be measured, in order: the plan minus what is committed."""
        left: NDArray[np.int64] = self.order[status[self.order] == 0]
        return left

    def record_s(self, rolls: Rolls) -> float:
        """Seconds that one record takes."""
        rate = self.excitation.sample_rate_hz
        if self.staggered is None:
            return record_samples(rolls, self.excitation.averages * self.excitation.period_samples, rate) / rate
        return rolls.pre_roll_s + (lead_samples(self.staggered, rolls) + self.staggered.used_samples) / rate

    def position_s(self, rolls: Rolls) -> float:
        """Seconds that one position takes: its records and the overhead around them."""
        return self.records * self.record_s(rolls) + POSITION_OVERHEAD_S

    def campaign_s(self, rows: NDArray[np.int64], rolls: Rolls, speed_m_s: float = GEL_SPEED_M_S) -> float:
        """Seconds that some positions take, sentinel and second looks included."""
        position_s = self.position_s(rolls)
        count = len(rows) + self.second_looks(rows, speed_m_s)
        return (count + self.drift.passes(count, position_s)) * position_s

    def second_looks(self, rows: NDArray[np.int64], speed_m_s: float = GEL_SPEED_M_S) -> int:
        """Number of positions that no neighbour can be expected to judge, so that they are measured twice.

        rows: The positions that are measured.
        speed_m_s: Phase speed of the plate's waves at the upper end of the band, > 0.
        """
        if not self.quality.confirms or not len(rows):
            return 0
        from calibration.neighbours.prediction import have_neighbours  # with it comes SciPy

        apart_mm = COARSE_WAVELENGTHS * 1e3 * speed_m_s / self.excitation.stop_hz
        return len(rows) - int(np.count_nonzero(have_neighbours(self.position_mm[rows], apart_mm)))


def lead_samples(signal: StaggeredSignal, rolls: Rolls) -> int:
    """Samples that a periodic signal plays before it counts: the player's latency, and one response to build up."""
    return round(rolls.post_roll_s * signal.sweep.sample_rate_hz) + signal.taps


def sentinel_of(plan: Plan, status: NDArray[np.uint8]) -> int | None:
    """The position re-measured for drift: the first valid one in the plan's order, if any."""
    valid = plan.order[status[plan.order] == 1]
    return int(valid[0]) if len(valid) else None
