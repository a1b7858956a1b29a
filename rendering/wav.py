"""Drives as WAV files at an audio interface's rate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import soundfile
from numpy.typing import NDArray

from calibration.errors import InputError
from drivers.audio.band_limited import converted, lead_samples, rate_ratio


def write_wav(
    path: Path,
    drive_v: NDArray[np.float64],
    sample_rate_hz: float,
    *,
    interface_rate_hz: int,
    full_scale_v: float,
) -> None:
    """Write drives as float32 WAV, one channel per actuator, 1.0 being full scale.

    The rates are converted by an exact rational ratio with a linear-phase low-pass, so that
    sample 0 of the file is sample 0 of the drive.

    Parameters
    ----------
    path : Path
        The file to write.
    drive_v : float64 array, shape (actuators, samples)
        Drives in volts.
    sample_rate_hz : float
        Rate of the drives.
    interface_rate_hz : int
        Rate of the audio interface.
    full_scale_v : float
        Volts at the interface's output for the value 1.0.

    Raises
    ------
    InputError
        The drive is beyond full scale, or the rates have no ratio of small whole numbers.
    """
    try:
        ratio = rate_ratio(sample_rate_hz, interface_rate_hz)
    except ValueError as error:
        raise InputError(f"{path}: {error}; choose a capture rate that goes evenly into the interface's") from error
    lead = lead_samples(ratio)
    reached_v = converted(drive_v, ratio)
    played_v = reached_v[:, lead : reached_v.shape[1] - lead]
    peak_v = float(np.max(np.abs(played_v), initial=0.0))
    if peak_v > full_scale_v:
        raise InputError(
            f"{path}: the drive reaches {peak_v:.3g} V, beyond the interface's full scale of {full_scale_v:g} V; "
            "set output.limit_v in the scene"
        )
    samples = (played_v / full_scale_v).astype(np.float32).T
    soundfile.write(path, samples, interface_rate_hz, subtype="FLOAT", format="WAV")
