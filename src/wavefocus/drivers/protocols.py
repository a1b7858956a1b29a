"""The roles of a rig as base classes, with a default for what not every device can do."""

from __future__ import annotations

import re
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from wavefocus.drivers.errors import InstrumentError

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RecordLabel:
    """Which measurement a record belongs to, for messages and logs.

    position: Row of the bank, from 0; number of the trial, from 1, where a stimulus is presented.
    attempt: 1 for the first try at this position.
    record: Index of the record within the attempt, from 0.
    purpose: ``"capture"``, ``"sentinel"``, ``"probe"``, ``"scan"`` or ``"presentation"``.
    """

    position: int
    attempt: int
    record: int
    purpose: str = "capture"

    def __str__(self) -> str:
        if self.purpose == "presentation":
            return f"presentation of trial {self.position}, attempt {self.attempt}"
        return f"{self.purpose} of position {self.position}, attempt {self.attempt}, record {self.record}"


@dataclass(frozen=True, slots=True)
class RecordRequest:
    """One finite two-channel record.

    samples: Samples per channel, pre-roll and post-roll included, > 0.
    sample_rate_hz: Rate of each channel in Hz, > 0.
    range_v: Largest input magnitude in volts on (reference, response), each > 0.
    label: What the record is for.
    """

    samples: int
    sample_rate_hz: float
    range_v: tuple[float, float]
    label: RecordLabel

    @property
    def duration_s(self) -> float:
        return self.samples / self.sample_rate_hz


@dataclass(frozen=True, slots=True)
class Recording:
    """The samples of one record.

    volts, float32 (2, samples): Row 0 the reference, row 1 the response, in volts at the DAQ inputs.
    volts_per_count: Converter step of each channel in volts.
    over_range: Whether each channel reached the end of its range.
    """

    volts: Float32Array
    volts_per_count: tuple[float, float]
    over_range: tuple[bool, bool]


class Clock(Protocol):
    """The time that the instruments live in: the wall's, or a virtual one."""

    def now_s(self) -> float:
        """Seconds since an arbitrary start; never runs backwards."""
        ...

    def sleep(self, seconds: float) -> None:
        """Let `seconds` pass."""
        ...


class Instrument(ABC):
    """What every role can do."""

    @property
    @abstractmethod
    def identity(self) -> DeviceIdentity:
        """Who the device is, as it said when it was opened; the device is not asked again."""

    @abstractmethod
    def identify(self) -> str:
        """The device and its settings in a sentence for people, asked of the device. Raises InstrumentError."""

    @abstractmethod
    def reconnect(self) -> None:
        """Drop the connection and open a fresh one to the same device; from any state but closed.

        Raises InstrumentLostError: the device is not there (yet): trying again later can help. InstrumentError: another
        device answers in its place.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the device, a player muted. Safe to call twice."""


class Mirror(Instrument):
    """Points the laser. Coordinates are optical angles in milliradians."""

    @abstractmethod
    def move_to(self, x_mrad: float, y_mrad: float) -> None:
        """Start a move and return at once. Raises InstrumentError outside the limits."""

    @abstractmethod
    def wait_settled(self, timeout_s: float) -> None:
        """Return when the beam stands still and a shutter is open. Raises InstrumentError after `timeout_s`."""

    @abstractmethod
    def park(self) -> None:
        """Move to the safe direction. Safe to call at any time, from any state."""

    def block(self) -> None:  # most mirrors have no shutter
        """Close the shutter, if any. Safe to call at any time, from any state. Raises InstrumentError."""

    def where_mrad(self) -> tuple[float, float] | None:
        """Where the device says that it points; None where it cannot say. Raises InstrumentError."""
        return None


class Shutter(Instrument):
    """Blocks the laser beam, or holds an interlock."""

    @abstractmethod
    def open_beam(self) -> None:
        """Let the beam through. Raises InstrumentError."""

    @abstractmethod
    def block_beam(self) -> None:
        """Block the beam. Safe to call at any time. Raises InstrumentError: whether it is blocked is unknown."""


class Recorder(Instrument):
    """Records the reference (loopback of the player) and the response (vibrometer)."""

    @abstractmethod
    def start(self, request: RecordRequest) -> None:
        """Start one finite record and return at once. Raises InstrumentError."""

    @abstractmethod
    def read(self, timeout_s: float) -> Recording:
        """Wait for the record to end and fetch it. Raises InstrumentError after `timeout_s`."""

    @abstractmethod
    def abort(self) -> None:
        """Drop a record under way. Safe to call at any time."""

    @property
    def input_ranges_v(self) -> tuple[float, ...]:
        """Largest magnitudes of its input ranges in volts, ascending; none where the device does not report them."""
        return ()

    def sampling_delay_s(self, sample_rate_hz: float) -> float | None:
        """How much later the response is sampled than the reference at a sample rate, in s, between two records.

        None where the device does not report it; 0 where each input has a converter. Raises InstrumentError.
        """
        return None


class Player(Instrument):
    """Plays one signal per channel of an audio interface."""

    @property
    @abstractmethod
    def channels(self) -> int:
        """Number of output channels."""

    @property
    @abstractmethod
    def full_scale_v(self) -> float:
        """Largest output magnitude in volts."""

    @abstractmethod
    def play(self, signals_v: Mapping[int, Float64Array], sample_rate_hz: float) -> None:
        """Start playing and return at once; channels not named stay silent.

        signals_v, mapping from channel to float64 (samples,): Output voltages; all of one length; never beyond
            `full_scale_v`.
        sample_rate_hz: Rate of the signals in Hz.

        Raises InstrumentError: unknown channel, voltage beyond full scale, device failure.
        """

    @abstractmethod
    def wait(self, timeout_s: float) -> None:
        """Return when everything has been played.

        Raises TransientInstrumentError: the device ran dry (underflow): what was recorded meanwhile is void.
        InstrumentError: the device is lost, or `timeout_s` passed.
        """

    @abstractmethod
    def mute(self) -> None:
        """Silence every channel at once. Safe to call at any time, from any state."""

    @property
    def latency_s(self) -> float:
        """How long after it was taken a sample leaves the outputs, as far as the device reports it."""
        raise self._no_pieces()

    @property
    def written_s(self) -> float:
        """When the last piece was handed to the interface, of `time.monotonic`; `add_piece` returns later."""
        raise self._no_pieces()

    def begin_pieces(self, channels: Sequence[int], sample_rate_hz: float, ahead_s: float) -> None:
        """Begin a play of any length that comes in pieces, at the interface's own rate; other channels stay silent.

        channels: In the order of the pieces' rows.
        sample_rate_hz: Rate of the pieces in Hz.
        ahead_s: It sounds when this much is there, or all of it; no more than that waits to be played.

        Raises InstrumentError: unknown channel, wrong rate, still playing, device failure, or the driver takes no
        pieces.
        """
        raise self._no_pieces()

    def add_piece(self, volts: Float64Array) -> float:
        """Hand over the next samples, (channels, any number), and return when there is room for more.

        Returns float: how much was still to be played before this piece came, in seconds. Raises
        TransientInstrumentError: it ran dry: the pieces came too late. It has faded out. InstrumentError: voltage
        beyond full scale, nothing begun, device failure.
        """
        raise self._no_pieces()

    def end_pieces(self) -> None:
        """Say that no more comes; `wait` returns when all of it was played."""
        raise self._no_pieces()

    def _no_pieces(self) -> InstrumentError:
        remedy = "render the scene to a drive file and play that"
        return InstrumentError("player", "playing piece by piece", "its driver takes no signal in pieces", remedy)


def uncounted(name: str) -> str:
    """A device's name without the number that Windows puts before it when it meets it in another socket."""
    return re.sub(r"(^|\()\d{1,3}- ", r"\1", name)


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """Who a device says it is, without its settings and without the way to it; equal for the same device in any run.

    maker, product, serial: As the device states them; empty where it does not. A device that answers with one text,
        whose parts nobody has specified, has that text as its product.
    """

    maker: str
    product: str
    serial: str = ""

    def is_same(self, other: DeviceIdentity) -> bool:
        """Whether both are one device; Windows counts audio interfaces anew in every socket: ``(2- X)``, ``(3- X)``."""
        return replace(self, product=uncounted(self.product)) == replace(other, product=uncounted(other.product))

    def __str__(self) -> str:
        name = f"{self.maker} {self.product}".strip()
        return f"{name}, serial number {self.serial}" if self.serial else name


class WallClock:
    """Real time."""

    def now_s(self) -> float:
        return time.perf_counter()  # time.monotonic has steps of 16 ms on Windows before Python 3.13

    def sleep(self, seconds: float) -> None:
        time.sleep(max(0.0, seconds))
