"""How long a mirror takes to settle, from its own position signals."""

from __future__ import annotations

import threading

import numpy as np

from wavefocus.acquisition.setup import Setup, naming_role
from wavefocus.calibration import Float64Array
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.timeouts import BoundedRecorder

RATE_HZ = 20_000.0
RECORD_S = 0.5
MOVE_AT_S = 0.15
SETTLED_SHARE = 0.01
"""Part of a step within which the mirror counts as settled."""
LEFT_SHARE = 0.02
MIN_STEP_V = 0.01
"""Position signals have some millivolts of noise."""


def measure_settling(
    setup: Setup, names: tuple[str, str], ends_mrad: tuple[tuple[float, float], tuple[float, float]]
) -> float:
    """Move the mirror from one direction to another while its position is recorded.

    names: Inputs of the recorder's box with the position signals of x and y.
    ends_mrad: The two directions.

    Returns the seconds from its leaving the first to its last being off the second, see `settling_s`.
    Raises InstrumentError: an instrument failed, or the signals show no move.
    """
    mirror, recorder = setup.instruments.mirror, setup.instruments.recorder
    assert isinstance(recorder, BoundedRecorder)
    start, end = ends_mrad
    with naming_role("mirror"):
        mirror.move_to(*start)
        mirror.wait_settled(setup.settle_timeout_s)
    recorded: list[Float64Array] = []
    failures: list[InstrumentError] = []

    def record() -> None:
        try:
            recorded.append(recorder.record_inputs_v(names, round(RECORD_S * RATE_HZ), RATE_HZ))
        except InstrumentError as failure:
            failures.append(failure)

    recording = threading.Thread(target=record, name="mirror position", daemon=True)
    recording.start()
    setup.instruments.clock.sleep(MOVE_AT_S)
    with naming_role("mirror"):
        mirror.move_to(*end)
        mirror.wait_settled(setup.settle_timeout_s)
    recording.join()  # the recorder's own call has an end
    if failures:
        raise failures[0]
    found = settling_s(recorded[0], RATE_HZ)
    if found is None:
        cause = f"{names[0]} and {names[1]} show no move from one mark to another"
        remedy = "wire the position signals there, or leave out x_position and y_position of [mirror]"
        raise InstrumentError("mirror", "measuring how it settles", cause, remedy)
    return found


def settling_s(position_v: Float64Array, sample_rate_hz: float) -> float | None:
    """Seconds that a step takes, from leaving its beginning to the last sample off its end; None without a step.

    position_v, float64 (axes, samples): A step, with rest in the first tenth and the last quarter of the record.
    """
    samples = position_v.shape[1]
    begin_v = np.median(position_v[:, : samples // 10], axis=1, keepdims=True)
    end_v = np.median(position_v[:, -(samples // 4) :], axis=1, keepdims=True)
    step_v = float(np.abs(end_v - begin_v).max())
    if step_v < MIN_STEP_V:
        return None
    noise_v = float(np.abs(position_v[:, -(samples // 4) :] - end_v).max())
    left = np.flatnonzero(np.abs(position_v - begin_v).max(axis=0) > max(LEFT_SHARE * step_v, 1.5 * noise_v))
    off = np.flatnonzero(np.abs(position_v - end_v).max(axis=0) > max(SETTLED_SHARE * step_v, 1.5 * noise_v))
    return float(max(off[-1] + 1 - left[0], 0) / sample_rate_hz)


def farthest_apart(angles_mrad: Float64Array) -> tuple[tuple[float, float], tuple[float, float]]:
    """The two of some directions, float64 (directions, 2), that are farthest apart."""
    distance = np.linalg.norm(angles_mrad[:, np.newaxis] - angles_mrad[np.newaxis], axis=2)
    first, second = np.unravel_index(int(np.argmax(distance)), distance.shape)
    (x0, y0), (x1, y1) = angles_mrad[first].tolist(), angles_mrad[second].tolist()
    return (x0, y0), (x1, y1)
