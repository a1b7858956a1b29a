"""Voltages as the stream's process receives them: checked, resampled to the interface's rate, each signal sent once."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from wavefocus.drivers.audio.resampling import converted, lead_samples, rate_ratio
from wavefocus.drivers.audio.stream.player_process import Forget, Store
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import Float32Array, Float64Array

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

    def forget(self) -> None:
        """Begin anew: the process that has the signals is gone."""
        self._shelf.clear()
        self._unsent.clear()

    def order(self, doing: str, signals_v: Mapping[int, Float64Array], sample_rate_hz: float) -> PlayOrder:
        """Turn voltages into an order; `doing` is for messages, the rest: `wavefocus.drivers.protocols.Player.play`.

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
        self._unsent += [
            Forget(number) for number in self._shelf.give_up({signal.number for signal in shelved.values()})
        ]
        zero = min(signal.first for signal in shelved.values())
        frames = max(signal.first + signal.frames for signal in shelved.values()) - zero
        voices = tuple((channel, signal.number, signal.first - zero) for channel, signal in shelved.items())
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
