"""From drives at the bank's rate to frames that the interface may get."""

from __future__ import annotations

import numpy as np

from wavefocus.drivers.audio.resampling import LiveConversion, rate_ratio
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.drive.coil_limits import DriveLimits
from wavefocus.rendering.drive.wav import Interface
from wavefocus.rendering.live.limiter import LiveLimiter
from wavefocus.storage.errors import InputError

LIMITER_S = 0.0025
"""Look-ahead of the limiter: half a period at 200 Hz, in the middle of what skin feels best."""


class LiveOutput:
    """Conversion to the interface's rate, and limits, block by block.

    delay_frames: By how many frames what comes out lags, in the conversion and the limiter.

    Raises InputError: the rates have no ratio of small whole numbers.
    """

    def __init__(self, interface: Interface, rate_hz: float, limits: DriveLimits) -> None:
        try:
            ratio = rate_ratio(rate_hz, interface.rate_hz)
        except ValueError as error:
            raise InputError(f"{error}; choose a capture rate that goes evenly into the interface's") from None
        look_ahead = max(1, round(LIMITER_S * interface.rate_hz))
        self._conversion = LiveConversion(len(interface.full_scale_v), ratio)
        self._limiter = LiveLimiter(limits, interface.full_scale_v, interface.rate_hz, look_ahead)
        self.rate_hz = interface.rate_hz
        self.delay_frames = round(self._conversion.delay_samples * ratio) + look_ahead

    @property
    def limited_db(self) -> float:
        """Least gain of the limiter in the last block, 0 where it did nothing."""
        return self._limiter.gain_db

    def frames(self, drive_v: Float64Array) -> Float64Array:
        """The next frames, (actuators, any number), of the next drives, (actuators, samples)."""
        return self._limiter.limit(np.ascontiguousarray(self._conversion.convert(drive_v)))
