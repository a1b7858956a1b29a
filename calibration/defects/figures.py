"""What is wrong with a record, in figures: each says how strong one defect is beyond what chance explains."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

DEFECTS = np.dtype(
    [
        ("burst_db", np.float32),
        ("burst_s", np.float32),
        ("cut_db", np.float32),
        ("cut_s", np.float32),
        ("slip_db", np.float32),
        ("slip_samples", np.float32),
        ("line_db", np.float32),
        ("line_hz", np.float32),
        ("tail_db", np.float32),
        ("step_db", np.float32),
        ("step_level_db", np.float32),
        ("harmonic_db", np.float32),
        ("dead", np.float32),
    ]
)
"""Defects of a record; energies are in dB of the response's in band, -inf where chance explains what is there,
NaN where nothing was looked at.

burst_db
    Residual within 5 ms, of the sweep where it is strongest.
burst_s
    When that is, in seconds from the start of the first sweep.
cut_db, cut_s
    Residual within 5 ms that every sweep leaves at the same place, all sweeps together, and when that is, in seconds
    from the start of a sweep: what is cut off in each the same way. NaN for a single sweep. The fit bends to it, so
    that the error of the Green's function is some 15 dB above.
slip_db
    What a jump of the delay between the two channels, from one sweep or part of a sweep to the next, explains
    of the differences between the sweeps.
slip_samples
    That jump, in samples; positive where the response gets later.
line_db, line_hz
    Strongest steady tone in the residual, and its frequency in Hz.
tail_db
    Response after the last of the L taps.
step_db, step_level_db
    Differences between the sweeps that are differences of their level, and the level of the sweep that is farthest from
    the others, in dB. NaN for a single sweep.
harmonic_db
    Third harmonic over the fundamental at the response's loudest moment.
dead
    1 where the response channel is constant, else 0.
"""


def not_looked_at(records: int) -> NDArray[np.void]:
    """Figures of records that were not examined: all NaN, shape (records,)."""
    defects = np.zeros(records, DEFECTS)
    for name in DEFECTS.names or ():
        defects[name] = np.nan
    return defects


def worst_of(defects: NDArray[np.void]) -> np.void:
    """One row of figures for several records of one actuator: each figure's largest, NaN only where all are."""
    worst: np.void = not_looked_at(1)[0]
    for name in DEFECTS.names or ():
        known = defects[name][~np.isnan(defects[name])]
        if known.size:
            worst[name] = known[np.argmax(np.abs(known))] if name == "slip_samples" else known.max()
    return worst
