"""The largest response that a drive makes at its foci, as the bank predicts it."""

from __future__ import annotations

import math

import numpy as np

from rendering.field.focus_figures import FocusInstant, emission_windows
from rendering.field.prediction import Prediction
from rendering.greens.source import GreenSource
from storage.drive_file import Drive

# Foci that are looked at, evenly spread over the scene.
MOST_FOCI = 16


def predicted_focus_peak(drive: Drive, bank: GreenSource) -> float | None:
    """Largest magnitude of the predicted response at the foci, each while it is emitted.

    Parameters
    ----------
    drive : Drive
        A scene's drives.
    bank : GreenSource
        The bank that they were made from.

    Returns
    -------
    float or None
        In the bank's response unit, of at most `MOST_FOCI` foci; None where there is none that is finite.
    """
    windows = emission_windows(drive)
    chosen = np.unique(np.linspace(0, len(windows) - 1, min(len(windows), MOST_FOCI)).round().astype(int))
    foci: dict[int, list[FocusInstant]] = {}
    for index in chosen.tolist():
        foci.setdefault(windows[index].row, []).append(windows[index])
    if not foci:
        return None
    peak, begin = 0.0, round(drive.start_s * drive.sample_rate_hz)
    with np.errstate(over="ignore", invalid="ignore"):
        prediction = Prediction(drive, bank, np.array(list(foci), dtype=np.int64), dtype=np.float64)
        for row, instants in foci.items():
            response = np.abs(prediction.respond(np.array([row], dtype=np.int64))[0])
            for one in instants:
                part = response[one.start_sample - begin : one.stop_sample - begin]
                peak = max(peak, float(part.max(initial=0.0)))
    return peak if math.isfinite(peak) else None
