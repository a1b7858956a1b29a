"""The three roles of a rig; the engine uses these and no particular device."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

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


@runtime_checkable
class Clock(Protocol):
    """The time that the instruments live in: the wall's, or a virtual one."""

    def now_s(self) -> float:
        """Seconds since an arbitrary start; never runs backwards."""
        ...

    def sleep(self, seconds: float) -> None:
        """Let `seconds` pass."""
        ...


@runtime_checkable
class Instrument(Protocol):
    """What every role can do."""

    @property
    def identity(self) -> DeviceIdentity:
        """Who the device is, as it said when it was opened; the device is not asked again."""
        ...

    def identify(self) -> str:
        """The device and its settings in a sentence for people, asked of the device. Raises InstrumentError."""
        ...

    def reconnect(self) -> None:
        """Drop the connection and open a fresh one to the same device; from any state but closed.

        Raises InstrumentLostError: the device is not there (yet): trying again later can help. InstrumentError: another
        device answers in its place.
        """
        ...

    def close(self) -> None:
        """Release the device. Safe to call twice."""
        ...


@runtime_checkable
class Mirror(Instrument, Protocol):
    """Points the laser. Coordinates are optical angles in milliradians."""

    def move_to(self, x_mrad: float, y_mrad: float) -> None:
        """Start a move and return at once. Raises InstrumentError outside the limits."""
        ...

    def wait_settled(self, timeout_s: float) -> None:
        """Return when the beam stands still. Raises InstrumentError after `timeout_s`."""
        ...

    def park(self) -> None:
        """Move to the safe direction. Safe to call at any time, from any state."""
        ...


@runtime_checkable
class Shutter(Instrument, Protocol):
    """Blocks the laser beam, or holds an interlock."""

    def open_beam(self) -> None:
        """Let the beam through. Raises InstrumentError."""
        ...

    def block_beam(self) -> None:
        """Block the beam. Safe to call at any time. Raises InstrumentError: whether it is blocked is unknown."""
        ...


@runtime_checkable
class BlocksBeam(Protocol):
    """A mirror that has a shutter, which is opened by `wait_settled` and closed at rest."""

    def block(self) -> None:
        """Close the shutter. Safe to call at any time, from any state. Raises InstrumentError."""
        ...


@runtime_checkable
class Recorder(Instrument, Protocol):
    """Records the reference (loopback of the player) and the response (vibrometer)."""

    def start(self, request: RecordRequest) -> None:
        """Start one finite record and return at once. Raises InstrumentError."""
        ...

    def read(self, timeout_s: float) -> Recording:
        """Wait for the record to end and fetch it. Raises InstrumentError after `timeout_s`."""
        ...

    def abort(self) -> None:
        """Drop a record under way. Safe to call at any time."""
        ...


@runtime_checkable
class OffersRanges(Protocol):
    """A recorder that says which input ranges it has, so that a record that was over one can be taken with a larger."""

    @property
    def input_ranges_v(self) -> tuple[float, ...]:
        """Largest magnitudes of its input ranges in volts, ascending; none where the device does not report them."""
        ...


@runtime_checkable
class StatesDelay(Protocol):
    """A recorder that knows the clock of its converter, and so how far apart in time its two inputs are sampled."""

    def sampling_delay_s(self, sample_rate_hz: float) -> float | None:
        """How much later the response is sampled than the reference at a sample rate, in s, between two records.

        None where the device does not report it; 0 where each input has a converter. Raises InstrumentError.
        """
        ...


@runtime_checkable
class RecordsInputs(Protocol):
    """A recorder that records two other inputs of its box, such as a mirror's position signals."""

    def record_inputs_v(self, names: tuple[str, str], samples: int, sample_rate_hz: float) -> NDArray[np.float64]:
        """Volts at two inputs from now on, shape (2, samples); between two records. Raises InstrumentError."""
        ...


@runtime_checkable
class Player(Instrument, Protocol):
    """Plays one signal per channel of an audio interface."""

    @property
    def channels(self) -> int:
        """Number of output channels."""
        ...

    @property
    def full_scale_v(self) -> float:
        """Largest output magnitude in volts."""
        ...

    def play(self, signals_v: Mapping[int, Float64Array], sample_rate_hz: float) -> None:
        """Start playing and return at once; channels not named stay silent.

        signals_v, mapping from channel to float64 (samples,): Output voltages; all of one length; never beyond
            `full_scale_v`.
        sample_rate_hz: Rate of the signals in Hz.

        Raises InstrumentError: unknown channel, voltage beyond full scale, device failure.
        """
        ...

    def wait(self, timeout_s: float) -> None:
        """Return when everything has been played.

        Raises TransientInstrumentError: the device ran dry (underflow): what was recorded meanwhile is void.
        InstrumentError: the device is lost, or `timeout_s` passed.
        """
        ...

    def mute(self) -> None:
        """Silence every channel at once. Safe to call at any time, from any state."""
        ...

    def close(self) -> None:
        """Release the device, muted. Safe to call twice."""
        ...


@runtime_checkable
class PiecewisePlayer(Player, Protocol):
    """A player that also takes a signal in pieces while it plays, so that it may be of any length."""

    @property
    def latency_s(self) -> float:
        """How long after it was taken a sample leaves the outputs, as far as the device reports it."""
        ...

    @property
    def written_s(self) -> float:
        """When the last piece was handed to the interface, of `time.monotonic`; `add_piece` returns later."""
        ...

    def begin_pieces(self, channels: Sequence[int], sample_rate_hz: float, ahead_s: float) -> None:
        """Begin a play that comes in pieces, at the interface's own rate; the other channels stay silent.

        channels: In the order of the pieces' rows.
        sample_rate_hz: Rate of the pieces in Hz.
        ahead_s: It sounds when this much is there, or all of it; no more than that waits to be played.

        Raises InstrumentError: unknown channel, wrong rate, still playing, device failure.
        """
        ...

    def add_piece(self, volts: Float64Array) -> float:
        """Hand over the next samples, (channels, any number), and return when there is room for more.

        Returns float: how much was still to be played before this piece came, in seconds. Raises
        TransientInstrumentError: it ran dry: the pieces came too late. It has faded out. InstrumentError: voltage
        beyond full scale, nothing begun, device failure.
        """
        ...

    def end_pieces(self) -> None:
        """Say that no more comes; `wait` returns when all of it was played."""
        ...


@dataclass(frozen=True, slots=True)
class Instruments:
    """The three instruments of a rig and the clock they live by."""

    mirror: Mirror
    recorder: Recorder
    player: Player
    clock: Clock


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
    """Real time; implements `wavefocus.drivers.protocols.Clock`."""

    def now_s(self) -> float:
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        time.sleep(max(0.0, seconds))
