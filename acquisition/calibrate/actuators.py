"""Polarity and drive level of the actuators: the surface's answer at the same distance from each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.calibrate.probe import TRIES, NotMeasuredError
from acquisition.measuring.plays import channels_of
from acquisition.measuring.record import point_at, take_record
from acquisition.measuring.setup import Setup
from calibration.clock.timing import ReferenceMissingError
from calibration.estimator.estimate import Estimate
from calibration.estimator.sequential import SequentialEstimator
from calibration.excitation.sweeps import Excitation
from calibration.rig.comparison import DEAD_SNR_DB, ActuatorComparison, Verdict, compare_actuators
from drivers.errors import TransientInstrumentError
from drivers.protocols import Take

REMEDIES: dict[Verdict, str] = {
    "dead": "check its cable, its amplifier channel and its coil, and that the beam meets the surface near it",
    "weak": "check its glue, its coil's gap and its amplifier's gain",
    "reversed": "swap the two wires of its coil, or leave it: a bank measured with it is right all the same",
    "unlike": "check the mirror map, its place in the rig file, its glue, and what touches the surface near it",
}
# Enough for sign and level, in the middle of the campaign's band.
BAND_HZ = (40.0, 400.0)
DURATION_S, DECAY_S = 0.5, 0.2
RESPONSE_S = 0.08  # the first waves; what comes back from the edge differs from place to place
# A record that fits worse was spoilt on the way, by speckle for instance.
POOR_RESIDUAL_DB = -30.0


@dataclass(frozen=True, slots=True)
class ActuatorsTask:
    """Where and how loudly the actuators are checked.

    position_mm, float64 (actuators, 2): Where each is listened to.
    amplitude_v: Peak of the sweep in volts.
    """

    position_mm: NDArray[np.float64]
    amplitude_v: float
    sample_rate_hz: float


def listening_places(actuator_mm: NDArray[np.float64], distance_mm: float) -> NDArray[np.float64]:
    """Places at one distance from each actuator, on the way to the surface's centre.

    actuator_mm, float64 (actuators, 2): Where the actuators are.
    distance_mm: Distance from each, > 0.

    Returns float64 (actuators, 2).
    """
    from_centre_mm = np.hypot(*actuator_mm.T)[:, np.newaxis]
    outwards = np.where(from_centre_mm > 0, actuator_mm / np.maximum(from_centre_mm, 1e-9), [[-1.0, 0.0]])
    return np.asarray(actuator_mm - distance_mm * outwards)


def measure_actuators(task: ActuatorsTask, setup: Setup, progress: Callable[[int, int], None]) -> ActuatorComparison:
    """Listen to each actuator at the same distance and compare them.

    task: Where and how loudly.
    setup: The rig, the vibrometer plugged into its response input.
    progress: Called with the actuators done and the actuators there are.

    Raises NotMeasuredError: no signal from the loopback, or a response is too loud for its input. InstrumentError: of
    the instrument that failed for good.
    """
    excitation = Excitation(task.sample_rate_hz, *BAND_HZ, DURATION_S, DECAY_S, task.amplitude_v, averages=1)
    estimator = SequentialEstimator(excitation, round(RESPONSE_S * task.sample_rate_hz), channels_of(setup))
    estimates: list[Estimate] = []
    for actuator, (x_mm, y_mm) in enumerate(task.position_mm):
        progress(actuator, len(task.position_mm))
        point_at(setup, float(x_mm), float(y_mm))
        estimates.append(_best_of(setup, excitation, estimator, actuator))
    progress(len(task.position_mm), len(task.position_mm))
    green = np.stack([one.green[0] for one in estimates])
    return compare_actuators(green, np.array([one.snr_db[0] for one in estimates]), task.sample_rate_hz)


def _best_of(setup: Setup, excitation: Excitation, estimator: SequentialEstimator, actuator: int) -> Estimate:
    """The best of a few records of one actuator; the first that is good enough ends it."""
    best: Estimate | None = None
    for attempt in range(1, TRIES + 1):
        try:
            estimate = _once(setup, excitation, estimator, Take(actuator, attempt, 0, "calibration"))
        except TransientInstrumentError:
            if attempt == TRIES and best is None:
                raise
            continue
        if best is None or estimate.residual_db[0] < best.residual_db[0]:
            best = estimate
        if best.residual_db[0] < POOR_RESIDUAL_DB and best.snr_db[0] > DEAD_SNR_DB:
            break
    assert best is not None  # the last attempt raises where none succeeded
    return best


def _once(setup: Setup, excitation: Excitation, estimator: SequentialEstimator, take: Take) -> Estimate:
    signals_v = setup.signals_v(excitation.signal_v(), take.position)
    recording = take_record(setup, signals_v, excitation.sample_rate_hz, take)
    if any(recording.over_range):
        raise NotMeasuredError(
            f"actuator {take.position} at {excitation.amplitude_v:g} V reaches the end of an input's range: lower "
            "--amplitude-v, or raise the ranges in the rig file"
        )
    try:
        return estimator.estimate(recording.volts[:1], recording.volts[1:], range_v=setup.range_v)
    except ReferenceMissingError as missing:
        raise NotMeasuredError(f"no signal from the loopback at the reference input ({missing})") from None
