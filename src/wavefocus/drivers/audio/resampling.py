"""Signals at an audio interface's rate: band-limited, by an exact ratio of whole numbers, sample 0 staying sample 0.

`PlayFrames` checks the voltages of a play and makes parts of full scale of them.
"""

import hashlib
import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import lru_cache

import numpy as np

from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import Float32Array, Float64Array

# Kaiser's window for 105 dB: flat up to 0.9 of half the lower rate and nothing left above it, both to -105 dB.
_CUT = 0.95
_BETA = 10.6
HALF_LENGTH = 72
"""Reach of the low-pass to either side, in periods of the lower rate."""

_MAX_TERM = 1000
"""Largest whole number in a ratio of rates; 44,100 to 48,000 is 160 / 147."""


def rate_ratio(from_hz: float, to_hz: float) -> Fraction:
    """The ratio of two rates. Raises ValueError.

    from_hz, to_hz: Rates in Hz.

    Returns Fraction: ``to_hz / from_hz``, exactly.
    """
    ratio = Fraction(0)
    if from_hz > 0 and to_hz > 0 and math.isfinite(from_hz * to_hz):
        ratio = (Fraction(to_hz) / Fraction(from_hz)).limit_denominator(_MAX_TERM)
    if not 0 < ratio.numerator <= _MAX_TERM or abs(float(ratio) * from_hz / to_hz - 1) > 1e-12:
        raise ValueError(f"the rates {from_hz:g} Hz and {to_hz:g} Hz have no ratio of whole numbers up to {_MAX_TERM}")
    return ratio


def lead_samples(ratio: Fraction) -> int:
    """How many samples at the new rate the conversion reaches beyond either end of a signal."""
    return 0 if ratio == 1 else math.ceil(HALF_LENGTH * max(1.0, float(ratio)))


def converted(signals: Float64Array, ratio: Fraction) -> Float64Array:
    """Signals at `ratio` times their rate, along the last axis.

    A signal is silence beyond its ends; what the low-pass makes of the ends comes along.

    signals, float64 (..., samples): Signals at any rate, at least one sample.
    ratio: New rate over old rate, > 0.

    Returns float64 (..., lead + ceil(samples * ratio) + lead): sample 0 of the signals is at index ``lead =
    lead_samples(ratio)``.
    """
    if ratio == 1:
        return signals
    from scipy.signal import upfirdn  # takes a third of a second to load

    up, down = ratio.numerator, ratio.denominator
    made = upfirdn(_filter(ratio), signals, up, down)
    wanted = 2 * lead_samples(ratio) + -(-signals.shape[-1] * up // down)
    return np.pad(made, [(0, 0)] * (signals.ndim - 1) + [(0, wanted - made.shape[-1])])


@lru_cache(maxsize=8)
def _filter(ratio: Fraction) -> Float64Array:
    """The low-pass at `up` times the old rate; its middle is `lead_samples` new samples behind its beginning."""
    half = lead_samples(ratio) * ratio.denominator
    return _low_pass(np.arange(-half, half + 1) / ratio.numerator, ratio)


def _low_pass(distance: Float64Array, ratio: Fraction) -> Float64Array:
    """Weights of old samples by their distance from a new one, in old samples."""
    lower = min(1.0, float(ratio))
    inside = np.clip(1 - (distance * lower / HALF_LENGTH) ** 2, 0, None)
    window = np.i0(_BETA * np.sqrt(inside)) / np.i0(_BETA) * (inside > 0)
    weights: Float64Array = lower * _CUT * np.sinc(lower * _CUT * distance) * window
    return weights


HALF_STEP = 2.0**-25
"""Half a step of a 24-bit converter, as a part of full scale: less than that at either end is silence."""

_FADED = 0.01
"""A signal that begins or ends above this part of its peak has no fade there."""


class BeyondFullScaleError(Exception):
    """Between its samples a signal is larger than the interface can put out.

    reaches: Its largest magnitude, as a part of full scale.
    """

    def __init__(self, reaches: float) -> None:
        super().__init__(f"reaches {reaches:.4g} of full scale")
        self.reaches = reaches


class PlayFrames:
    """Checks signals and converts them; a signal that comes again is not converted again.

    full_scale_v: Volts at full scale of each channel.
    """

    def __init__(self, name: str, full_scale_v: Sequence[float], rate_hz: int) -> None:
        self._name = name
        self._full_scale_v = tuple(full_scale_v)
        self._rate_hz = rate_hz
        self._converted: OrderedDict[tuple[bytes, float, Fraction], tuple[Float32Array, int]] = OrderedDict()

    def frames(self, doing: str, signals_v: Mapping[int, Float64Array], sample_rate_hz: float) -> Float32Array:
        """Parts of full scale at the interface's rate, (frames, channels), in the order of `signals_v`.

        Arguments: `doing` is for messages, the rest as for `wavefocus.drivers.protocols.Player.play`. Raises
        InstrumentError.
        """
        lengths = {volts.size for volts in signals_v.values()}
        if len(lengths) != 1 or 0 in lengths:
            raise self._refusal(doing, f"signals of {sorted(lengths)} samples", "give signals of one length, not empty")
        try:
            ratio = rate_ratio(sample_rate_hz, self._rate_hz)
        except ValueError as error:
            remedy = "choose a capture rate that goes evenly into player.interface_rate_hz"
            raise self._refusal(doing, str(error), remedy) from None
        for channel, volts in signals_v.items():
            self._check(doing, channel, volts)
        made = [self._convert(doing, channel, volts, ratio) for channel, volts in signals_v.items()]
        zero = min(first for _, first in made)
        whole = np.zeros((max(first + part.size for part, first in made) - zero, len(made)), dtype=np.float32)
        for column, (part, first) in enumerate(made):
            whole[first - zero : first - zero + part.size, column] = part
        return whole

    def _check(self, doing: str, channel: int, volts: Float64Array) -> None:
        channels, full_scale_v = len(self._full_scale_v), min(self._full_scale_v)
        if not 0 <= channel < channels:
            raise self._refusal(doing, f"there is no channel {channel}", f"choose 0 to {channels - 1}")
        peak_v = float(np.abs(volts).max())
        if volts.ndim != 1 or not peak_v <= full_scale_v:
            raise self._refusal(
                doing,
                f"the signal of channel {channel} has the shape {volts.shape} and reaches {peak_v:g} V",
                f"give finite voltages within ±{full_scale_v:g} V, one row",
            )

    def _convert(self, doing: str, channel: int, volts: Float64Array, ratio: Fraction) -> tuple[Float32Array, int]:
        full_scale_v = self._full_scale_v[channel]
        key = (hashlib.sha256(volts.tobytes()).digest(), full_scale_v, ratio)
        if key not in self._converted:
            try:
                self._converted[key] = converted_frames(volts / full_scale_v, ratio)
            except BeyondFullScaleError as beyond:
                raise self._refusal(
                    doing,
                    f"between its samples the signal of channel {channel} reaches {beyond.reaches * full_scale_v:.4g}"
                    f" V, beyond the full scale of {full_scale_v:g} V",
                    f"scale it down by {20 * math.log10(beyond.reaches) + 0.01:.2f} dB",
                ) from None
        self._converted.move_to_end(key)
        made = self._converted[key]
        # At most 256 MB of converted signals are kept.
        while len(self._converted) > 1 and sum(part.size for part, _ in self._converted.values()) > 64_000_000:
            self._converted.popitem(last=False)
        return made

    def _refusal(self, doing: str, cause: str, remedy: str) -> InstrumentError:
        return InstrumentError(self._name, doing, cause, remedy)


def converted_frames(parts: Float64Array, ratio: Fraction) -> tuple[Float32Array, int]:
    """Parts of full scale at the interface's rate, silence at either end left out, and the frame at which they begin.

    Frame 0 is sample 0 of what was given; what the conversion adds before it is negative. Raises BeyondFullScaleError.
    """
    frames, lead = converted(parts, ratio), lead_samples(ratio)
    beyond = np.abs(frames) > 1
    if beyond.any():
        # Up to -80 dB beyond full scale is the low-pass's own ripple, and cut off.
        beyond &= np.abs(frames) > 1 + 1e-4
        audible = _FADED * float(np.abs(parts).max())
        if abs(parts[0]) > audible:
            beyond[: 2 * lead] = False
        if abs(parts[-1]) > audible:
            beyond[max(0, frames.size - 2 * lead) :] = False
        if beyond.any():
            raise BeyondFullScaleError(float(np.abs(frames[beyond]).max()))
        frames = np.clip(frames, -1, 1)
    sounding = np.flatnonzero(np.abs(frames) > HALF_STEP)
    # The given samples stay whole, so that a play lasts as long as its signal, silence in it or not.
    first = min(lead, int(sounding[0])) if sounding.size else lead
    stop = max(frames.size - lead, int(sounding[-1]) + 1) if sounding.size else frames.size - lead
    return np.ascontiguousarray(frames[first:stop], dtype=np.float32), first - lead
