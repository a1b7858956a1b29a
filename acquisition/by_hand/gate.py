"""A player that falls silent at once, whoever is waiting for it."""

from __future__ import annotations

import threading
from collections.abc import Mapping

from drivers.errors import InstrumentError
from drivers.protocols import DeviceIdentity, Float64Array, Player


class ShutError(InstrumentError):
    """Nothing is played, for it was to be silent meanwhile."""


class GatedPlayer:
    """A player with a gate that another thread may shut; implements `drivers.protocols.Player`.

    Whoever owns the instruments may be in the middle of a record when a person says mute: the other thread shuts the
    gate, which silences what sounds and lets nothing more begin until the owner has opened it as often as it was shut.

    Parameters
    ----------
    player : Player
        The player; its `mute` may be called from any thread, as its role demands.
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
