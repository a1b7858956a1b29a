"""The plan: everything that a campaign will do, as data that dry run, engine and resume all walk."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from acquisition.quality import QualityLimits
from acquisition.record import Rolls, record_samples
from calibration.sweeps import Excitation
from drivers.protocols import Float64Array

# Time of a mirror move, of starting a task and of a commit, for the estimate before a run.
POSITION_OVERHEAD_S = 0.05


@dataclass(frozen=True, slots=True)
class Plan:
    """A campaign: which positions, in which order, with what excitation.

    Parameters
    ----------
    position_mm : float64 array, shape (positions, 2)
        The grid, in the bank's order.
    actuator_mm : float64 array, shape (actuators, 2)
        Where the actuators are.
    order : int64 array, shape (positions,)
        Bank rows in the order of measurement.
    excitation : Excitation
        What plays in each record.
    taps : int
        Length L of the Green's functions.
    sha256 : str
        Hash of all that a resume must not change.
    quality : QualityLimits
        When a position is good enough.
    """

    position_mm: Float64Array
    actuator_mm: Float64Array
    order: NDArray[np.int64]
    excitation: Excitation
    taps: int
    sha256: str
    quality: QualityLimits = field(default_factory=QualityLimits)

    @property
    def positions(self) -> int:
        """Number of grid positions."""
        return len(self.position_mm)

    @property
    def actuators(self) -> int:
        """Number of actuators."""
        return len(self.actuator_mm)

    def to_do(self, status: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Bank rows still to be measured, in order: the plan minus what is committed."""
        left: NDArray[np.int64] = self.order[status[self.order] == 0]
        return left

    def position_s(self, rolls: Rolls) -> float:
        """Seconds that one position takes: a record per actuator and the overhead around them."""
        rate = self.excitation.sample_rate_hz
        signal_samples = self.excitation.averages * self.excitation.period_samples
        record_s = record_samples(rolls, signal_samples, rate) / rate
        return self.actuators * record_s + POSITION_OVERHEAD_S


def sentinel_of(plan: Plan, status: NDArray[np.uint8]) -> int | None:
    """The position re-measured for drift: the first valid one in the plan's order, if any."""
    valid = plan.order[status[plan.order] == 1]
    return int(valid[0]) if len(valid) else None
