"""Frames that the interface may get, of drives at its rate."""

from __future__ import annotations

from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.drive.coil_limits import DriveLimits
from wavefocus.rendering.drive.wav import Interface
from wavefocus.rendering.live.limiter import LiveLimiter

LIMITER_S = 0.0025
"""Look-ahead of the limiter: half a period at 200 Hz, in the middle of what skin feels best."""


class LiveOutput:
    """Limits of an interface, block by block.

    delay_frames: By how many frames what comes out lags.
    """

    def __init__(self, interface: Interface, limits: DriveLimits) -> None:
        self.rate_hz, self.delay_frames = interface.rate_hz, max(1, round(LIMITER_S * interface.rate_hz))
        self._limiter = LiveLimiter(limits, interface.full_scale_v, interface.rate_hz, self.delay_frames)

    @property
    def limited_db(self) -> float:
        """Least gain of the limiter in the last block, 0 where it did nothing."""
        return self._limiter.gain_db

    def frames(self, drive_v: Float64Array) -> Float64Array:
        """The next frames, (actuators, frames), of the next drives, as many."""
        return self._limiter.limit(drive_v)
