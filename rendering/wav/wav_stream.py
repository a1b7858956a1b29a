"""Drives as a WAV file while they are rendered: scenes of any length in constant memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import soundfile
from numpy.typing import NDArray

from rendering.wav.interface_rate import InterfaceRate
from storage.errors import InputError
from storage.output_files import replacement, require_room

Float64Array = NDArray[np.float64]

CHUNK_SAMPLES = 2**15
_HEADER_BYTES = 4096


@contextmanager
def sound_failures(path: Path) -> Iterator[None]:
    """Name the file in failures of the library that writes sounds.

    Raises
    ------
    InputError
        It cannot be written.
    """
    try:
        yield
    except (soundfile.LibsndfileError, AssertionError) as error:  # the library asserts that all frames were written
        raise InputError(f"{path} cannot be written ({error or 'not all samples were written'})") from error


def stream_wav(
    path: Path,
    blocks: Iterable[Float64Array],
    shape: tuple[int, int],
    sample_rate_hz: float,
    *,
    interface_rate_hz: int,
    full_scale_v: float,
    chunk_samples: int = CHUNK_SAMPLES,
) -> float:
    """Write drives as float32 WAV as they come, one channel per actuator, 1.0 being full scale.

    The rates are converted by an exact rational ratio with a linear-phase low-pass, so that
    sample 0 of the file is sample 0 of the drive.

    Parameters
    ----------
    path : Path
        The file to write; an older one is replaced when the new one is whole.
    blocks : iterable of float64 array, shape (actuators, any number of samples)
        The drives in volts, one block after the other.
    shape : tuple of int
        Actuators and samples of the whole drive.
    sample_rate_hz : float
        Rate of the drives.
    interface_rate_hz : int
        Rate of the audio interface.
    full_scale_v : float
        Volts at the interface's output for the value 1.0.
    chunk_samples : int
        About so many samples of drive are converted at a time, > 0.

    Returns
    -------
    float
        Largest magnitude at the interface's rate, in volts.

    Raises
    ------
    InputError
        A drive is beyond full scale or cannot be rendered, or the rates have no ratio of small whole numbers.
    """
    try:
        rate = InterfaceRate(sample_rate_hz, interface_rate_hz)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    actuators, samples = shape
    largest_v = 0.0
    seconds = samples / sample_rate_hz
    with replacement(path) as temporary, sound_failures(path):
        require_room(temporary, round(4 * actuators * seconds * interface_rate_hz) + _HEADER_BYTES)
        with soundfile.SoundFile(
            temporary, "w", samplerate=interface_rate_hz, channels=actuators, subtype="FLOAT", format="WAV"
        ) as file:
            for played_v in rate.pieces(blocks, actuators, samples, chunk_samples):
                peak_v = float(max(played_v.max(initial=0.0), -played_v.min(initial=0.0)))
                if peak_v > full_scale_v:
                    raise InputError(
                        f"{path}: the drive reaches {peak_v:.3g} V, beyond the interface's full scale of"
                        f" {full_scale_v:g} V; set output.limit_v in the scene, or name the rig with --rig"
                    )
                file.write((played_v / full_scale_v).astype(np.float32).T)
                largest_v = max(largest_v, peak_v)
    return largest_v
