"""Drives as WAV files at an audio interface's rate."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import soundfile
from numpy.typing import NDArray
from scipy.signal import firwin, resample_poly

from calibration.errors import InputError

# 100 dB of stop-band and a transition of 4 % of the lower rate: the band of a bank ends far below it.
_STOP_BAND_BETA = 10.06
_HALF_LENGTH = 160


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
    ratio = Fraction(interface_rate_hz) / Fraction(sample_rate_hz).limit_denominator(1000)
    if max(ratio.numerator, ratio.denominator) > 1000:
        raise InputError(
            f"{path}: the rates {sample_rate_hz:g} Hz and {interface_rate_hz} Hz have no ratio of whole numbers "
            "up to 1000; choose a capture rate that goes evenly into the interface's"
        )
    played_v = resampled(drive_v, ratio)
    peak_v = float(np.max(np.abs(played_v), initial=0.0))
    if peak_v > full_scale_v:
        raise InputError(
            f"{path}: the drive reaches {peak_v:.3g} V, beyond the interface's full scale of {full_scale_v:g} V; "
            "set output.limit_v in the scene"
        )
    samples = (played_v / full_scale_v).astype(np.float32).T
    soundfile.write(path, samples, interface_rate_hz, subtype="FLOAT", format="WAV")


def resampled(signals: NDArray[np.float64], ratio: Fraction) -> NDArray[np.float64]:
    """Signals at `ratio` times their rate, band-limited, along the last axis."""
    up, down = ratio.numerator, ratio.denominator
    if up == down:
        return signals
    longest = max(up, down)
    window = firwin(2 * _HALF_LENGTH * longest + 1, 0.96 / longest, window=("kaiser", _STOP_BAND_BETA))
    converted = resample_poly(signals, up, down, axis=-1, window=window)  # type: ignore[call-overload]  # stub gap
    return np.asarray(converted, dtype=np.float64)
