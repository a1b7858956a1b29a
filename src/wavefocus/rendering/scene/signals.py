"""Signals that a source emits, at the bank's rate and with peak 1."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from wavefocus.rendering.arrays import Float64Array
from wavefocus.storage.argument_types import check_fields
from wavefocus.storage.errors import InputError
from wavefocus.storage.text_file import require_whole_sound

if TYPE_CHECKING:
    from soundfile import SoundFile as SoundFileReader


MAX_SAMPLES = 2**31
"""No signal and no scene may have more."""


class Signal(Protocol):
    """Anything that gives its samples at a rate."""

    def samples(self, sample_rate_hz: float) -> Float64Array:
        """Samples at `sample_rate_hz`, float64 (n,). Raises InputError where that cannot be."""


@dataclass(frozen=True, slots=True)
class Impulse:
    """One sample of 1."""

    def samples(self, sample_rate_hz: float) -> Float64Array:
        return np.ones(1)


@dataclass(frozen=True, slots=True)
class Sine:
    """A sine of amplitude 1 and phase 0, without a fade.

    frequency_hz: Above 0 and below half the bank's rate.
    duration_s: Rounded to whole samples (half to even), at least two.
    """

    frequency_hz: float
    duration_s: float

    def __post_init__(self) -> None:
        check_fields(self)

    def samples(self, sample_rate_hz: float) -> Float64Array:
        """Samples at `sample_rate_hz`.

        Raises InputError: the frequency is not between 0 and Nyquist, or nothing is left to emit.
        """
        if not 0 < self.frequency_hz < sample_rate_hz / 2:
            raise InputError(
                f"frequency_hz is {self.frequency_hz}; it must be above 0 and below {sample_rate_hz / 2:g},"
                " half the bank's rate"
            )
        time = np.arange(_sample_count(self.duration_s, sample_rate_hz)) / sample_rate_hz
        sine: Float64Array = np.sin(2.0 * np.pi * self.frequency_hz * time)
        _check_audible(sine, f"a sine of {self.duration_s} s")
        return sine


@dataclass(frozen=True, slots=True)
class Noise:
    """Gaussian noise with nothing outside its band, peak 1.

    Drawn from PCG64 as standard normals, which NumPy keeps stable, and cut to the band (edges included) in
    the domain of its own discrete Fourier transform, so that the same seed gives the same noise everywhere.

    band_hz: Lower and upper edge, 0 <= lower < upper <= half the bank's rate.
    duration_s: Rounded to whole samples (half to even), at least one.
    seed: >= 0.
    """

    band_hz: tuple[float, float]
    duration_s: float
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self)
        object.__setattr__(self, "band_hz", tuple(self.band_hz))

    def samples(self, sample_rate_hz: float) -> Float64Array:
        """Samples at `sample_rate_hz`.

        Raises InputError: the band or the seed is not allowed, or the band holds no bin of so short a noise.
        """
        lower, upper = self.band_hz
        if not 0 <= lower < upper <= sample_rate_hz / 2:
            raise InputError(
                f"band_hz is [{lower}, {upper}]; it must rise and lie within 0 and {sample_rate_hz / 2:g},"
                " half the bank's rate"
            )
        if self.seed < 0:
            raise InputError(f"seed is {self.seed}; it must be 0 or above")
        count = _sample_count(self.duration_s, sample_rate_hz)
        white = np.random.Generator(np.random.PCG64(self.seed)).standard_normal(count)
        frequency = np.fft.rfftfreq(count, 1.0 / sample_rate_hz)
        cut = (frequency < lower) | (frequency > upper)
        banded: Float64Array = white
        if cut.any():
            spectrum = np.fft.rfft(white)
            spectrum[cut] = 0.0
            banded = np.fft.irfft(spectrum, count)
        what = f"noise of {self.duration_s} s between {lower} and {upper} Hz"
        return banded / _check_audible(banded, what, silent_below=1e-12)


@dataclass(frozen=True, slots=True)
class SoundFile:
    """The first channel of a sound file, resampled to the bank's rate, peak 1.

    path: The file, of a kind with a header. Its rate is brought to the bank's by a polyphase low-pass (Kaiser window,
        64 zero crossings each side), so that nothing above either Nyquist frequency folds back.
    """

    path: str | Path

    def __post_init__(self) -> None:
        check_fields(self)
        object.__setattr__(self, "path", Path(self.path))

    def samples(self, sample_rate_hz: float) -> Float64Array:
        """Samples at `sample_rate_hz`.

        Raises InputError: the file cannot be read, is silent, or holds NaN or infinity.
        """
        with self._opened() as file:
            # Block by block, because a header can declare any number of frames and channels.
            blocks, at_once = [np.zeros(0)], max(1, (2**20) // file.channels)
            while len(block := file.read(at_once, dtype="float64", always_2d=True)):
                blocks.append(block[:, 0].copy())
            channel, rate_hz = np.concatenate(blocks), file.samplerate
        if not np.isfinite(channel).all():
            raise InputError(f"{self.path} holds NaN or infinity; finite samples are needed")
        if channel.size and rate_hz != sample_rate_hz:
            channel = _resample(channel, Fraction(sample_rate_hz) / rate_hz)
        return channel / _check_audible(channel, str(self.path))

    def declared(self) -> tuple[int, int]:
        """Frames that the file declares, and its rate in Hz. Raises InputError: the file cannot be read."""
        with self._opened() as file:
            return file.frames, file.samplerate

    @contextmanager
    def _opened(self) -> Iterator[SoundFileReader]:
        import soundfile

        try:
            require_whole_sound(Path(self.path))
            with soundfile.SoundFile(self.path) as file:
                yield file
        except (soundfile.LibsndfileError, OSError, TypeError) as error:  # TypeError: a kind without a header
            raise InputError(f"{self.path} cannot be read as a sound file: {error}") from error


SIGNALS: Mapping[str, Callable[..., Signal]] = {"impulse": Impulse, "sine": Sine, "noise": Noise, "file": SoundFile}
"""Signals by the kind of a table of `wavefocus.config.scene`, whose keys are their parameters."""


def signal_size(signal: Signal, sample_rate_hz: float) -> tuple[float, float]:
    """Samples of a signal at a rate, and the most that are held while it is made; found without making it.

    Raises InputError: a sound file cannot be read.
    """
    if (duration_s := getattr(signal, "duration_s", None)) is not None:
        samples = duration_s * sample_rate_hz
        return samples, samples
    if isinstance(signal, SoundFile):
        frames, rate_hz = signal.declared()
        samples = frames * sample_rate_hz / rate_hz
        return samples, max(samples, frames)
    count = len(signal.samples(sample_rate_hz))
    return count, count


def _resample(values: Float64Array, ratio: Fraction) -> Float64Array:
    # 10,000 keeps the filter small; the rate is then met to 1e-8.
    ratio = ratio.limit_denominator(10_000)
    up, down = ratio.numerator, ratio.denominator
    if up == 0:
        raise InputError("the sound file's rate is more than 10,000 times the bank's")
    from scipy import signal as scipy_signal  # half a second of start, for sound files of another rate alone

    widest = max(up, down)
    low_pass: Any = scipy_signal.firwin(2 * 64 * widest + 1, 1.0 / widest, window=("kaiser", 12.0))
    resampled: Float64Array = scipy_signal.resample_poly(values, up, down, window=low_pass)
    return resampled


def _sample_count(duration_s: float, sample_rate_hz: float) -> int:
    if not (math.isfinite(duration_s) and duration_s > 0):
        raise InputError(f"duration_s is {duration_s}; it must be a finite number above 0")
    if duration_s * sample_rate_hz > MAX_SAMPLES:
        raise InputError(f"duration_s is {duration_s}; that is more than {MAX_SAMPLES} samples")
    count = round(duration_s * sample_rate_hz)
    if count < 1:
        raise InputError(f"duration_s is {duration_s}; at {sample_rate_hz:g} Hz that leaves no sample to emit")
    return count


def _check_audible(values: Float64Array, what: str, *, silent_below: float = 0.0) -> float:
    """Return the largest magnitude of a signal; refuse one that is empty or silent."""
    peak = float(np.abs(values).max(initial=0.0))
    if peak <= silent_below:
        raise InputError(f"{what} is empty or silent; a source needs something to emit")
    return peak
