"""What no wave of one wave number explains: a field whose wave numbers fill a disk, by Gaussian process regression."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigh

from wavefocus.calibration import Complex128Array, Float64Array
from wavefocus.calibration.wave_model import disk_kernel

REST_JUDGED, REST_POSITIONS = 16, 400
"""Frequencies at which the rest is judged, and positions that judge it, at most."""
NO_REST = (0.0, 1.0)
REST_RIDGES = tuple(np.geomspace(1e-6, 1.0, 13).tolist())
REST_RADIUS, REST_RESOLVED = 1.15, (0.5, 1.0)
"""Radius of the rest's disk in wave numbers; or in shares of what the positions resolve, pi over their spacing. Half of
it averages noise and still holds the near fields of bending waves, which all of it does not tell from noise."""
MAX_REST = 0.95
"""Where left-out positions keep more than this share of the residuals, in the median and in the mean square, there is
no rest."""


def choose_rest(
    residual: Complex128Array, apart_mm: Float64Array, wavenumber: float, resolved: float
) -> tuple[float, float]:
    """Radius of the rest's disk in rad/mm, 0 for none; ridge.

    Those of greatest evidence, each actuator's rest with a power of its own. Where the positions do not resolve the
    waves, a rest between them is anyone's guess, and there is none.

    residual, complex128 (positions, actuators): What the waves leave at some positions.
    apart_mm, float64 (positions, positions): Their distances.
    wavenumber: Of the waves, in rad/mm.
    resolved: Largest wave number that the positions resolve.
    """
    if wavenumber > resolved:
        return NO_REST
    tries = []
    for radius in (REST_RADIUS * wavenumber, *(share * resolved for share in REST_RESOLVED)):
        size, turn = eigh(disk_kernel(radius * apart_mm))
        seen = np.square(np.abs(turn.T @ residual))
        for ridge in REST_RIDGES:
            power = np.maximum(size, 0.0) + ridge
            by_actuator = np.maximum((seen / power[:, None]).mean(axis=0), 1e-300)
            cost = np.log(power).mean() + np.log(by_actuator).mean()
            tries.append((float(cost), float(radius), ridge))
    _, radius, ridge = min(tries)
    missed = np.linalg.norm(left_out_rest(disk_kernel(radius * apart_mm), ridge, residual)[0], axis=1)
    there = np.maximum(np.linalg.norm(residual, axis=1), 1e-300)
    left = min(float(np.median(missed / there)), float(np.linalg.norm(missed) / np.linalg.norm(there)))
    return (radius, ridge) if left < MAX_REST else NO_REST


def left_out_rest(
    kernel: Float64Array, ridge: float, residual: Complex128Array
) -> tuple[Complex128Array, Float64Array]:
    """Error at each position if it is left out, ``(C^-1 r)_i / (C^-1)_ii`` with C = K + ridge, and 1 / (C^-1)_ii."""
    inverse = cho_solve(cho_factor(kernel + ridge * np.eye(len(kernel))), np.eye(len(kernel)))
    share = 1.0 / inverse.diagonal()
    return np.asarray(inverse @ residual * share[:, None]), np.asarray(share)
