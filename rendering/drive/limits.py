"""Keeping a drive within what may be played: scaled, never clipped."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from storage.errors import InputError

Float64Array = NDArray[np.float64]


def scale_to_limit(drive_v: Float64Array, limit_v: float | None, *, finite: bool = False) -> float:
    """Scale a drive down, in place, until no sample is larger than the limit.

    Parameters
    ----------
    drive_v : float64 array, shape (actuators, samples)
        Volts, finite.
    limit_v : float, optional
        Largest magnitude allowed, > 0; None: no limit.
    finite : bool
        Whether all samples are known to be finite.

    Returns
    -------
    float
        The factor applied, at most 1; 1 if nothing was.

    Raises
    ------
    InputError
        The drive holds NaN or infinity, or the limit is not a finite number above 0.
    """
    if limit_v is None and finite:
        return 1.0
    peak_v = float(max(drive_v.max(initial=0.0), -drive_v.min(initial=0.0)))
    if not math.isfinite(peak_v):
        actuator = int(np.argmin(np.isfinite(drive_v).all(axis=1)))
        raise InputError(
            f"the drive of actuator {actuator} does not fit into float64; lower the amplitude or check the bank"
        )
    if limit_v is None:
        return 1.0
    if not (math.isfinite(limit_v) and limit_v > 0):
        raise InputError(f"limit_v is {limit_v}; it must be a finite number above 0")
    if peak_v <= limit_v:
        return 1.0
    scale = limit_v / peak_v
    while peak_v * scale > limit_v:
        scale = math.nextafter(scale, 0.0)
    if scale == 0.0:
        raise InputError(f"limit_v is {limit_v}, but the drive reaches {peak_v:.3g} V; no factor reaches so far")
    drive_v *= scale
    return scale
