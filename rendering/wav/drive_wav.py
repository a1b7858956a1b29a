"""Drives as WAV files at an audio interface's rate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rendering.wav.wav_stream import CHUNK_SAMPLES, stream_wav


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
    pieces = (drive_v[:, begin : begin + CHUNK_SAMPLES] for begin in range(0, drive_v.shape[1], CHUNK_SAMPLES))
    stream_wav(
        path,
        pieces,
        (drive_v.shape[0], drive_v.shape[1]),
        sample_rate_hz,
        interface_rate_hz=interface_rate_hz,
        full_scale_v=full_scale_v,
    )
