"""From voltages to what the stream's process is told: checks, conversion, and each signal handed over once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from drivers.audio.band_limited import rate_ratio
from drivers.audio.signal_shelf import BeyondFullScaleError, ShelvedSignal, SignalShelf
from drivers.errors import InstrumentError
from drivers.message_pipe import Message

Float64Array = NDArray[np.float64]

Order = tuple[Message, bytes | memoryview]


@dataclass(frozen=True, slots=True)
class PlayOrder:
    """One play as the stream's process is told of it.

    Parameters
    ----------
    voices : list of [int, int, int]
        Channel, number of its signal, and the frame at which it begins.
    frames : int
        Length at the interface's rate.
    before : list of Order
        What has to be said first: new signals, and those that may be forgotten.
    """

    voices: list[list[int]]
    frames: int
    before: list[Order]


class PlayOrders:
    """Checks signals and makes orders of them.

    Parameters
    ----------
    name : str
        The player's, for messages.
    full_scale_v : sequence of float
        Volts at full scale of each channel.
    rate_hz : int
        Rate of the interface in Hz.
    """

    def __init__(self, name: str, full_scale_v: Sequence[float], rate_hz: int) -> None:
        self._name = name
        self._full_scale_v = tuple(full_scale_v)
        self._rate_hz = rate_hz
        self._shelf = SignalShelf()
        self._unsaid: list[Order] = []

    @property
    def signals_converted(self) -> int:
        """How many signals were converted so far; a repeated one is not."""
        return self._shelf.made

    @property
    def full_scale_v(self) -> float:
        """The smallest full scale of all channels, in volts."""
        return min(self._full_scale_v)

    def forget(self) -> None:
        """Begin anew: the process that was told is gone."""
        self._shelf.clear()
        self._unsaid.clear()

    def order(self, doing: str, signals_v: Mapping[int, Float64Array], sample_rate_hz: float) -> PlayOrder:
        """Turn voltages into an order.

        Parameters
        ----------
        doing : str
            What is under way, for messages.
        signals_v, sample_rate_hz
            As of `drivers.protocols.Player.play`.

        Raises
        ------
        InstrumentError
            They cannot be played.
        """
        lengths = {volts.size for volts in signals_v.values()}
        if len(lengths) != 1 or 0 in lengths:
            raise self._refusal(doing, f"signals of {sorted(lengths)} samples", "give signals of one length, not empty")
        ratio = self._ratio(doing, sample_rate_hz)
        for channel, volts in signals_v.items():
            self._check(doing, channel, volts)
        shelved = {channel: self._shelve(doing, channel, volts, ratio) for channel, volts in signals_v.items()}
        for number in self._shelf.give_up({one.number for one in shelved.values()}):
            self._unsaid.append(({"do": "forget", "signal": number}, b""))
        zero = min(one.first for one in shelved.values())
        frames = max(one.first + one.frames for one in shelved.values()) - zero
        voices = [[channel, one.number, one.first - zero] for channel, one in shelved.items()]
        before, self._unsaid = self._unsaid, []
        return PlayOrder(voices, frames, before)

    def _ratio(self, doing: str, sample_rate_hz: float) -> Fraction:
        try:
            return rate_ratio(sample_rate_hz, self._rate_hz)
        except ValueError as error:
            remedy = "choose a capture rate that goes evenly into player.interface_rate_hz"
            raise self._refusal(doing, str(error), remedy) from None

    def _check(self, doing: str, channel: int, volts: Float64Array) -> None:
        channels = len(self._full_scale_v)
        if not 0 <= channel < channels:
            raise self._refusal(doing, f"there is no channel {channel}", f"choose 0 to {channels - 1}")
        peak_v = float(np.abs(volts).max())
        if volts.ndim != 1 or not peak_v <= self.full_scale_v:
            raise self._refusal(
                doing,
                f"the signal of channel {channel} has the shape {volts.shape} and reaches {peak_v:g} V",
                f"give finite voltages within +-{self.full_scale_v:g} V, one row",
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
            self._unsaid.append(({"do": "store", "signal": shelved.number}, frames.data.cast("B")))
        return shelved

    def _refusal(self, doing: str, cause: str, remedy: str) -> InstrumentError:
        return InstrumentError(self._name, doing, cause, remedy)
