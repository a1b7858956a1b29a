"""Voltages as the stream's process receives them: checked, resampled to the interface's rate, each signal sent once."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from drivers.audio.stream.player_process import Forget, Store
from drivers.errors import InstrumentError

Float64Array = NDArray[np.float64]

# Kaiser's window for 105 dB: flat up to 0.9 of half the lower rate and nothing left above it, both to -105 dB.
CUT = 0.95
BETA = 10.6
HALF_LENGTH = 72
"""Reach of the low-pass to either side, in periods of the lower rate."""

PRODUCTS_AT_ONCE = 200_000
"""Few enough that OpenBLAS multiplies on this thread: its others would take the cores from the audio, spinning."""

LARGEST_TERM = 1000
"""Largest whole number in a ratio of rates; 44,100 to 48,000 is 160 / 147."""


def rate_ratio(from_hz: float, to_hz: float) -> Fraction:
    """The ratio of two rates. Raises ValueError.

    from_hz, to_hz: Rates in Hz.

    Returns Fraction: ``to_hz / from_hz``, exactly.
    """
    ratio = Fraction(0)
    if from_hz > 0 and to_hz > 0 and math.isfinite(from_hz * to_hz):
        ratio = (Fraction(to_hz) / Fraction(from_hz)).limit_denominator(LARGEST_TERM)
    if not 0 < ratio.numerator <= LARGEST_TERM or abs(float(ratio) * from_hz / to_hz - 1) > 1e-12:
        raise ValueError(
            f"the rates {from_hz:g} Hz and {to_hz:g} Hz have no ratio of whole numbers up to {LARGEST_TERM}"
        )
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
    up, down = ratio.numerator, ratio.denominator
    before, weights = _weights(ratio)
    lead = lead_samples(ratio)
    samples = signals.shape[-1]
    wanted = lead + -(-samples * up // down) + lead
    # Every `down` old samples give `up` new ones, by the same weights: one product of matrices.
    early = -(-lead // up)
    blocks = early + -(-(wanted - lead) // up)
    start = early * down + before
    room = max(0, blocks * down + len(weights) - start - samples)
    padded = np.pad(signals, [(0, 0)] * (signals.ndim - 1) + [(start, room)])
    windows = np.lib.stride_tricks.sliding_window_view(padded, len(weights), axis=-1)[..., ::down, :]
    made = np.empty((*signals.shape[:-1], blocks, up))
    at_once = max(1, PRODUCTS_AT_ONCE // weights.size)
    for block in range(0, blocks, at_once):
        here = slice(block, min(block + at_once, blocks))
        made[..., here, :] = np.ascontiguousarray(windows[..., here, :]) @ weights
    first = early * up - lead
    return made.reshape(*signals.shape[:-1], blocks * up)[..., first : first + wanted]


@lru_cache(maxsize=8)
def _weights(ratio: Fraction) -> tuple[int, Float64Array]:
    """How many old samples before its first a block needs, and the weights (old samples, new samples) of a block."""
    reach = HALF_LENGTH * max(1.0, 1 / float(ratio))
    around = math.ceil(reach)
    place = np.arange(ratio.numerator) * ratio.denominator / ratio.numerator
    distance = np.arange(-around, ratio.denominator + around)[:, np.newaxis] - place
    inside = np.clip(1 - (distance / reach) ** 2, 0, None)
    window = np.i0(BETA * np.sqrt(inside)) / np.i0(BETA) * (inside > 0)
    cut = CUT * min(1.0, float(ratio))
    weights: Float64Array = cut * np.sinc(cut * distance) * window
    return around, weights


Float32Array = NDArray[np.float32]

HALF_STEP = 2.0**-25
"""Half a step of a 24-bit converter, as a part of full scale: less than that at either end is silence."""

RIPPLE = 1e-4
"""So much beyond full scale is the low-pass's own ripple, and cut off: -80 dB."""


FADED = 0.01
"""A signal that begins or ends above this part of its peak has no fade there."""


class BeyondFullScaleError(Exception):
    """Between its samples a signal is larger than the interface can put out.

    reaches: Its largest magnitude, as a part of full scale.
    """

    def __init__(self, reaches: float) -> None:
        super().__init__(f"reaches {reaches:.4g} of full scale")
        self.reaches = reaches


@dataclass(frozen=True, slots=True)
class ShelvedSignal:
    """A signal at the interface's rate.

    number: Its name, never used again for another.
    frames: Its length at the interface's rate.
    first: The frame at which it begins: 0 is sample 0 of what was given, negative what the conversion adds before.
    """

    number: int
    frames: int
    first: int


@dataclass(slots=True)
class _Held:
    volts: Float64Array
    shelved: ShelvedSignal


class SignalShelf:
    """Recognises signals by their content: new ones have to be sent, the longest unused are dropped.

    largest_frames: How many frames to keep in all; the longest unused go first. What one play needs is kept at any
        rate.
    """

    def __init__(self, largest_frames: int = 64_000_000) -> None:
        self._largest_frames = largest_frames
        self._held: OrderedDict[tuple[object, ...], _Held] = OrderedDict()
        self._given_up: list[int] = []
        self._frames = 0
        self._made = 0

    @property
    def made(self) -> int:
        """How many signals were converted so far; one that was recognised is not."""
        return self._made

    def find(
        self, volts: Float64Array, full_scale_v: float, ratio: Fraction
    ) -> tuple[ShelvedSignal, Float32Array | None]:
        """A signal as parts of full scale at the interface's rate. Raises BeyondFullScaleError.

        volts, float64 (samples,): In volts, finite, at least one sample.

        Returns ShelvedSignal: where it is found; float32 (frames,), or None: its frames if they are new.
        """
        key = (volts.size, full_scale_v, ratio, volts[:: max(1, volts.size // 64)].tobytes())
        held = self._held.get(key)
        if held is not None and np.array_equal(held.volts, volts):
            self._held.move_to_end(key)
            return held.shelved, None
        frames, first = _frames(volts / full_scale_v, ratio)
        self._made += 1
        if held is not None:
            self._give_up(key)
        held = _Held(volts.copy(), ShelvedSignal(self._made, frames.size, first))
        self._held[key] = held
        self._frames += frames.size
        return held.shelved, frames

    def give_up(self, needed: set[int]) -> list[int]:
        """Forget what exceeds the shelf, except signals that are needed.

        Returns list of int: the numbers of all that were forgotten since the last call.
        """
        for key, held in list(self._held.items()):
            if self._frames <= self._largest_frames:
                break
            if held.shelved.number not in needed:
                self._give_up(key)
        given_up, self._given_up = self._given_up, []
        return given_up

    def clear(self) -> None:
        """Forget everything: the owner of the signals is gone."""
        self._held.clear()
        self._given_up.clear()
        self._frames = 0

    def _give_up(self, key: tuple[object, ...]) -> None:
        shelved = self._held.pop(key).shelved
        self._frames -= shelved.frames
        self._given_up.append(shelved.number)


def _frames(parts: Float64Array, ratio: Fraction) -> tuple[Float32Array, int]:
    """Parts of full scale at the interface's rate, silence at either end left out, and where they begin."""
    frames, lead = converted(parts, ratio), lead_samples(ratio)
    beyond = np.abs(frames) > 1
    if beyond.any():
        beyond &= np.abs(frames) > 1 + RIPPLE
        audible = FADED * float(np.abs(parts).max())
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


@dataclass(frozen=True, slots=True)
class PlayOrder:
    """One play as the stream's process gets it.

    voices: Channel, number of its signal, and the frame at which it begins.
    frames: Length at the interface's rate.
    before: New signals, and those that may be forgotten; to be sent first.
    """

    voices: tuple[tuple[int, int, int], ...]
    frames: int
    before: list[Store | Forget]


class PlayOrders:
    """Checks signals and makes orders of them.

    full_scale_v: Volts at full scale of each channel.
    """

    def __init__(self, name: str, full_scale_v: Sequence[float], rate_hz: int) -> None:
        self._name = name
        self._full_scale_v = tuple(full_scale_v)
        self._rate_hz = rate_hz
        self._shelf = SignalShelf()
        self._unsent: list[Store | Forget] = []

    @property
    def signals_converted(self) -> int:
        """How many signals were converted so far; a repeated one is not."""
        return self._shelf.made

    def forget(self) -> None:
        """Begin anew: the process that has the signals is gone."""
        self._shelf.clear()
        self._unsent.clear()

    def order(self, doing: str, signals_v: Mapping[int, Float64Array], sample_rate_hz: float) -> PlayOrder:
        """Turn voltages into an order; `doing` is for messages, the rest is as of `drivers.protocols.Player.play`.

        Raises InstrumentError.
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
        shelved = {channel: self._shelve(doing, channel, volts, ratio) for channel, volts in signals_v.items()}
        self._unsent += [Forget(number) for number in self._shelf.give_up({one.number for one in shelved.values()})]
        zero = min(one.first for one in shelved.values())
        frames = max(one.first + one.frames for one in shelved.values()) - zero
        voices = tuple((channel, one.number, one.first - zero) for channel, one in shelved.items())
        before, self._unsent = self._unsent, []
        return PlayOrder(voices, frames, before)

    def _check(self, doing: str, channel: int, volts: Float64Array) -> None:
        channels, full_scale_v = len(self._full_scale_v), min(self._full_scale_v)
        if not 0 <= channel < channels:
            raise self._refusal(doing, f"there is no channel {channel}", f"choose 0 to {channels - 1}")
        peak_v = float(np.abs(volts).max())
        if volts.ndim != 1 or not peak_v <= full_scale_v:
            raise self._refusal(
                doing,
                f"the signal of channel {channel} has the shape {volts.shape} and reaches {peak_v:g} V",
                f"give finite voltages within +-{full_scale_v:g} V, one row",
            )

    def _shelve(self, doing: str, channel: int, volts: Float64Array, ratio: Fraction) -> ShelvedSignal:
        full_scale_v = self._full_scale_v[channel]
        try:
            shelved, frames = self._shelf.find(volts, full_scale_v, ratio)
        except BeyondFullScaleError as beyond:
            raise self._refusal(
                doing,
                f"between its samples the signal of channel {channel} reaches {beyond.reaches * full_scale_v:.4g} V,"
                f" beyond the full scale of {full_scale_v:g} V",
                f"scale it down by {20 * math.log10(beyond.reaches) + 0.01:.2f} dB",
            ) from None
        if frames is not None:
            self._unsent.append(Store(shelved.number, frames))
        return shelved

    def _refusal(self, doing: str, cause: str, remedy: str) -> InstrumentError:
        return InstrumentError(self._name, doing, cause, remedy)
