"""Drives at an audio interface's rate, and as WAV files, piece by piece: the same numbers as in one piece."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavefocus.drivers.audio.resampling import HALF_LENGTH, converted, lead_samples, rate_ratio
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.drive.coil_limits import Limiting, Reached, peaks, strictest
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import replacement, require_room

BETWEEN_SAMPLES = "full scale of the interface between samples"
CHUNK_SAMPLES = 2**15


@dataclass(frozen=True, slots=True, eq=False)
class Interface:
    """The outputs that drives are converted for.

    full_scale_v, float64 (actuators,): Volts at full scale of each actuator's output.
    """

    rate_hz: int
    full_scale_v: Float64Array

    def strictest(self, levels: Sequence[Reached], peaks_v: Float64Array, between_v: Float64Array) -> Limiting:
        """Find the factor for some levels, and for the full scale between samples.

        A drive that is beyond full scale at its samples, although it is within its limits, is not scaled for it: it is
        refused where it is played or written.

        peaks_v, between_v: Largest magnitudes at the samples and at the interface's rate, (actuators,).
        """
        limiting = strictest(levels)
        if (peaks_v * limiting.scale > self.full_scale_v).any():
            return limiting
        return strictest([*levels, self.reached(between_v)])

    def between_v(self, drive_v: Float64Array, sample_rate_hz: float) -> Float64Array:
        """Largest magnitudes of a drive at the interface's rate, (actuators,): between samples it may be larger.

        Raises InputError: the rates have no ratio of small whole numbers.
        """
        rate = InterfaceRate(sample_rate_hz, self.rate_hz)
        actuators, samples = drive_v.shape
        return largest_of(rate.pieces(_in_chunks([drive_v]), actuators, samples, CHUNK_SAMPLES), actuators)

    def reached(self, largest_v: Float64Array) -> Reached:
        """Largest magnitudes at the interface's rate, (actuators,), and the outputs' full scale."""
        # Outputs of different full scale are held against the smallest.
        least_v = float(self.full_scale_v.min())
        return Reached(BETWEEN_SAMPLES, least_v, largest_v * (least_v / self.full_scale_v), summed=True)


class InterfaceRate:
    """The way from the rate of drives to that of an interface; sample 0 stays sample 0.

    Raises InputError: the rates have no ratio of small whole numbers.
    """

    def __init__(self, sample_rate_hz: float, interface_rate_hz: int) -> None:
        try:
            self._ratio = rate_ratio(sample_rate_hz, interface_rate_hz)
        except ValueError as error:
            raise InputError(f"{error}; choose a capture rate that goes evenly into the interface's") from error
        up, down = self._ratio.numerator, self._ratio.denominator
        # Whole blocks of the conversion, so that its weights fall on the same samples as in one piece.
        reach = HALF_LENGTH * max(1.0, 1 / float(self._ratio))
        self.around_samples = 0 if self._ratio == 1 else down * math.ceil(reach / down)
        """Samples of drive beyond a piece that it is made of, too."""
        self._skipped = lead_samples(self._ratio) + self.around_samples * up // down

    def pieces(
        self, blocks: Iterable[Float64Array], actuators: int, samples: int, piece_samples: int
    ) -> Iterator[Float64Array]:
        """Give drives at the interface's rate, piece by piece, as blocks of them come."""
        up, down = self._ratio.numerator, self._ratio.denominator
        left = math.ceil(samples * self._ratio)
        for chunk in self._chunks(blocks, actuators, down * max(1, piece_samples // down)):
            count = min((chunk.shape[1] - 2 * self.around_samples) * up // down, left)
            yield converted(chunk, self._ratio)[:, self._skipped : self._skipped + count]
            left -= count

    def _chunks(self, blocks: Iterable[Float64Array], actuators: int, length: int) -> Iterator[Float64Array]:
        """The drives in chunks of `length` samples with some more on either side, silence beyond the ends."""
        around = self.around_samples
        waiting = np.zeros((actuators, around))
        for block in blocks:
            waiting = np.concatenate([waiting, block], axis=1)
            while waiting.shape[1] >= length + 2 * around:
                yield waiting[:, : length + 2 * around]
                waiting = waiting[:, length:]
        rest = max(waiting.shape[1] - around, 0)
        if rest:
            padded = np.pad(waiting, ((0, 0), (0, -rest % self._ratio.denominator + around)))
            for begin in range(0, rest, length):
                yield padded[:, begin : begin + length + 2 * around]


def largest_of(pieces: Iterable[Float64Array], actuators: int) -> Float64Array:
    """Largest magnitude of each actuator over all pieces, (actuators,)."""
    largest = np.zeros(actuators)
    for piece in pieces:
        largest = np.maximum(largest, peaks(piece))
    return largest


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

    Returns largest magnitude at the interface's rate, in volts. Raises InputError: a drive is beyond full scale or
    cannot be rendered, or the rates have no ratio of small whole numbers.
    """
    import soundfile  # loaded by those who write a file

    from wavefocus.storage.exchange.wav import sound_failures  # with it comes all that reads banks of others

    try:
        rate = InterfaceRate(sample_rate_hz, interface_rate_hz)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    actuators, samples = shape
    largest_v = 0.0
    seconds = samples / sample_rate_hz
    with replacement(path) as temporary, sound_failures(path):
        size = round(4 * actuators * seconds * interface_rate_hz) + 4096
        require_room(temporary, size)
        with soundfile.SoundFile(
            temporary, "w", samplerate=interface_rate_hz, channels=actuators, subtype="FLOAT", format=wav_format(size)
        ) as file:
            for played_v in rate.pieces(_in_chunks(blocks), actuators, samples, chunk_samples):
                peak_v = float(peaks(played_v).max())
                if peak_v > full_scale_v:
                    raise InputError(
                        f"{path}: the drive reaches {peak_v:.3g} V, beyond the interface's full scale of"
                        f" {full_scale_v:g} V; set output.limit_v in the scene, or name the rig with --rig"
                    )
                file.write((played_v / full_scale_v).astype(np.float32).T)
                largest_v = max(largest_v, peak_v)
    return largest_v


def wav_format(size: int) -> str:
    """Format of a file of so many bytes: the header of a WAV file counts them in 32 bits, that of RF64 in 64."""
    return "WAV" if size < 2**32 else "RF64"  # EBU Tech 3306


def _in_chunks(blocks: Iterable[Float64Array]) -> Iterator[Float64Array]:
    """Drives (actuators, samples) in pieces that do not take much memory when they are converted."""
    for block in blocks:
        for begin in range(0, block.shape[1], CHUNK_SAMPLES):
            yield block[:, begin : begin + CHUNK_SAMPLES]
