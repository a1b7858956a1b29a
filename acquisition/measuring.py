"""What plays at each position and how it is estimated, whatever the schedule."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from acquisition.plan import Plan
from acquisition.setup import Setup
from calibration.blas import one_blas_thread
from calibration.estimator import Estimate, Estimator
from drivers.protocols import Float32Array, Float64Array


@dataclass(frozen=True, slots=True)
class Play:
    """What one record plays.

    Parameters
    ----------
    actuator : int
        The actuator that sounds; the first of them where several do.
    signals_v : mapping from player channel to float64 array, shape (samples,)
        Output volts, all of one length, the loopback channel included.
    """

    actuator: int
    signals_v: Mapping[int, Float64Array]


class EstimatesPosition(Protocol):
    """From all records of a position to the Green's functions of all actuators."""

    def estimate(
        self, reference_v: Float32Array, response_v: Float32Array, *, range_v: tuple[float, float]
    ) -> Estimate:
        """Estimate from all records of a position, a record per row, as `calibration.position_estimator` has it."""


@dataclass(frozen=True, slots=True)
class Measuring:
    """How every position of a campaign is measured.

    Parameters
    ----------
    plays : tuple of Play
        The records of a position, in order.
    estimator : EstimatesPosition
        What their recordings become.
    """

    plays: tuple[Play, ...]
    estimator: EstimatesPosition


def measuring_of(plan: Plan, setup: Setup) -> Measuring:
    """The records that a plan asks for on a rig, and their estimator."""
    signal_v = plan.excitation.signal_v()
    plays = tuple(
        Play(actuator, {channel: signal_v, setup.loopback_channel: signal_v})
        for actuator, channel in enumerate(setup.actuator_channels)
    )
    with one_blas_thread():
        estimator = Estimator(
            plan.excitation,
            plan.taps,
            reference_gain=setup.reference_gain,
            response_per_volt=setup.response_per_volt,
            inter_channel_delay_s=setup.response_delay_s,
        )
    return Measuring(plays, estimator)
