"""Live level of the response while a person points the laser, and a player that falls silent at once."""

from __future__ import annotations

import threading
from collections.abc import Mapping

import numpy as np

from acquisition.measuring.record import ANSWER_MARGIN_S, take_record
from acquisition.measuring.setup import Setup, asking
from calibration.excitation.sweeps import Excitation
from config.messages.operate import ChannelLevel, InputLevels
from drivers.errors import InstrumentError
from drivers.protocols import DeviceIdentity, Float64Array, Player, Recording, RecordRequest, Take


class ShutError(InstrumentError):
    """Nothing is played, for it was to be silent meanwhile."""


class GatedPlayer:
    """A player with a gate that another thread may shut; implements `drivers.protocols.Player`.

    Whoever owns the instruments may be in the middle of a record when a person says mute: the other thread shuts the
    gate, which silences what sounds and lets nothing more begin until the owner has opened it as often as it was shut.

    player: The player; its `mute` may be called from any thread, as its role demands.
    """

    def __init__(self, player: Player) -> None:
        self._player = player
        self._lock = threading.Lock()
        self._shut = 0

    @property
    def is_shut(self) -> bool:
        """Whether nothing may sound."""
        return self._shut > 0

    def shut(self) -> None:
        """Fall silent, and stay so until `open`."""
        with self._lock:
            self._shut += 1
        self._player.mute()

    def open(self) -> None:
        """Take one `shut` back; does no harm where there was none."""
        with self._lock:
            self._shut = max(0, self._shut - 1)

    @property
    def channels(self) -> int:
        """Number of output channels."""
        return self._player.channels

    @property
    def full_scale_v(self) -> float:
        """Largest output magnitude in volts."""
        return self._player.full_scale_v

    @property
    def identity(self) -> DeviceIdentity:
        """Who the device is."""
        return self._player.identity

    def identify(self) -> str:
        """Name, model and serial number of the device."""
        return self._player.identify()

    def play(self, signals_v: Mapping[int, Float64Array], sample_rate_hz: float) -> None:
        """Start playing; refused while the gate is shut, and silenced when it is shut meanwhile."""
        if not self.is_shut:
            self._player.play(signals_v, sample_rate_hz)
            if not self.is_shut:
                return
            self._player.mute()
        raise ShutError("player", "playing", "it was muted meanwhile", "give the order again")

    def wait(self, timeout_s: float) -> None:
        """Return when everything has been played, or silenced."""
        self._player.wait(timeout_s)

    def mute(self) -> None:
        """Silence every channel at once."""
        self._player.mute()

    def reconnect(self) -> None:
        """Open the same device afresh."""
        self._player.reconnect()

    def close(self) -> None:
        """Release the device, muted."""
        self._player.close()


LISTENS_S = 0.1
_FADE_S = 0.005
_BAND_HZ = (40.0, 400.0)


def level_of(recording: Recording, range_v: tuple[float, float]) -> InputLevels:
    """Levels of a record."""
    one, other = (
        ChannelLevel(
            rms_v=float(volts.std(dtype=np.float64)),
            peak_v=float(np.abs(volts).max(initial=0.0)),
            offset_v=float(volts.mean(dtype=np.float64)),
            range_v=end_v,
            over_range=bool(reached),
        )
        for volts, end_v, reached in zip(recording.volts, range_v, recording.over_range, strict=True)
    )
    return InputLevels(one, other)


def listen(setup: Setup, seconds: float, sample_rate_hz: float, number: int) -> Recording:
    """Record while nothing plays.

    seconds: How long, > 0.
    number: Which record of its kind this is, for messages.

    Raises InstrumentError: of the recorder, which was stopped.
    """
    recorder = setup.instruments.recorder
    request = RecordRequest(
        max(1, round(seconds * sample_rate_hz)), sample_rate_hz, setup.range_v, Take(0, 1, number, "listening")
    )
    with asking("recorder"):
        try:
            recorder.start(request)
            return recorder.read(request.duration_s + ANSWER_MARGIN_S)
        except BaseException:
            recorder.abort()
            raise


class LevelMeter:
    """Hears both inputs again and again, in silence or while one actuator plays short sweeps."""

    def __init__(self, setup: Setup, sample_rate_hz: float) -> None:
        self._setup = setup
        self._rate_hz = sample_rate_hz
        self._number = 0
        self._signal_v: Float64Array | None = None
        self._channel = -1

    def sound(self, actuator: int | None, amplitude_v: float = 0.0) -> None:
        """Choose what plays meanwhile: an actuator at a peak of so many volts, or nothing."""
        self._signal_v = None
        if actuator is not None:
            self._channel = self._setup.actuator_channels[actuator]
            self._signal_v = Excitation(
                self._rate_hz, *_BAND_HZ, LISTENS_S, 0.0, amplitude_v, averages=1, fade_s=_FADE_S
            ).signal_v()

    def measure(self) -> InputLevels:
        """Levels now.

        Raises InstrumentError: of the instrument that failed.
        """
        self._number += 1
        setup = self._setup
        if self._signal_v is None:
            recording = listen(setup, LISTENS_S, self._rate_hz, self._number)
        else:
            signals_v = {setup.loopback_channel: self._signal_v, self._channel: self._signal_v}
            recording = take_record(setup, signals_v, self._rate_hz, Take(0, 1, self._number, "listening"))
        return level_of(recording, setup.range_v)
