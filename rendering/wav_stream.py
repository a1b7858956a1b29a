"""Drives as a WAV file while they are rendered: scenes of any length in constant memory."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import soundfile
from numpy.typing import NDArray

from calibration.errors import InputError
from drivers.audio.band_limited import HALF_LENGTH, converted, lead_samples, rate_ratio
from rendering.live import LiveDrive

Float64Array = NDArray[np.float64]

CHUNK_SAMPLES = 2**15


def stream_wav(
    path: Path, live: LiveDrive, *, interface_rate_hz: int, full_scale_v: float, chunk_samples: int = CHUNK_SAMPLES
) -> float:
    """Write the drives as `rendering.wav.write_wav` does, as they come.

    Parameters
    ----------
    path : Path
        The file to write; it is removed again if the drives cannot be written to their end.
    live : LiveDrive
        The drives.
    interface_rate_hz : int
        Rate of the audio interface.
    full_scale_v : float
        Volts at the interface's output for the value 1.0.
    chunk_samples : int
        About so many samples of drive are converted at a time, > 0.

    Returns
    -------
    float
        Largest drive in volts.

    Raises
    ------
    InputError
        A drive is beyond full scale or the scene's limit, or the rates have no ratio of small whole numbers.
    """
    rate_hz = live.sample_rate_hz
    try:
        ratio = rate_ratio(rate_hz, interface_rate_hz)
    except ValueError as error:
        raise InputError(f"{path}: {error}; choose a capture rate that goes evenly into the interface's") from error
    up, down = ratio.numerator, ratio.denominator
    # Whole blocks of the conversion, so that its weights fall on the same samples as in one piece.
    around = down * math.ceil(HALF_LENGTH * max(1.0, 1 / float(ratio)) / down) if ratio != 1 else 0
    skipped, largest_v, written = lead_samples(ratio) + around * up // down, 0.0, 0
    whole = math.ceil(live.samples * ratio)
    try:
        with soundfile.SoundFile(
            path, "w", samplerate=interface_rate_hz, channels=live.actuators, subtype="FLOAT", format="WAV"
        ) as file:
            for chunk in _chunks(live, around, down * max(1, chunk_samples // down)):
                count = min((chunk.shape[1] - 2 * around) * up // down, whole - written)
                played_v = converted(chunk, ratio)[:, skipped : skipped + count]
                peak_v = float(max(played_v.max(initial=0.0), -played_v.min(initial=0.0)))
                if peak_v > full_scale_v:
                    raise InputError(
                        f"{path}: the drive reaches {peak_v:.3g} V, beyond the interface's full scale of"
                        f" {full_scale_v:g} V; lower the gain or set output.limit_v in the scene and render it first"
                    )
                file.write((played_v / full_scale_v).astype(np.float32).T)
                largest_v, written = max(largest_v, peak_v), written + count
    except BaseException:
        path.unlink(missing_ok=True)
        raise
    return largest_v


def _chunks(live: LiveDrive, around: int, length: int) -> Iterator[Float64Array]:
    """The drives in chunks of `length` samples with `around` more on either side, silence beyond the ends."""
    waiting = np.zeros((live.actuators, around))
    for block in live.blocks():
        waiting = np.concatenate([waiting, block], axis=1)
        while waiting.shape[1] >= length + 2 * around:
            yield waiting[:, : length + 2 * around]
            waiting = waiting[:, length:]
    rest = max(waiting.shape[1] - around, 0)
    if rest:
        chunks = -(-rest // length)
        padded = np.pad(waiting, ((0, 0), (0, chunks * length + 2 * around - waiting.shape[1])))
        for chunk in range(chunks):
            yield padded[:, chunk * length : (chunk + 1) * length + 2 * around]
