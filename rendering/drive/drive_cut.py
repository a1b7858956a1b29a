"""Drives cut into blocks.

Where bins are left out, one block fades into the next: cut off sharply, each would have frequencies that the
drive has not.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]

PLAIN_EXPONENT = 1000
SINGLE_EXPONENT = 20
"""Drives times powers of two below this can be rounded to single precision before they are scaled."""


class CutDrive:
    """Drives of any size, scaled to one of about 1 as they are cut.

    Parameters
    ----------
    drive_v : float64 array, shape (actuators, samples)
        Drives.
    exponent : int
        They are of size about two to this power.
    """

    def __init__(self, drive_v: Float64Array, exponent: int) -> None:
        plain = abs(exponent) < PLAIN_EXPONENT
        self._values = drive_v if plain else np.ldexp(drive_v, -exponent)
        self._factor = 2.0**-exponent if plain else 1.0
        self._early = abs(exponent) < SINGLE_EXPONENT
        self.actuators, self.samples = int(drive_v.shape[0]), int(drive_v.shape[1])

    def cut(self, block: int, hop: int, fade: int, out: NDArray[Any], actuators: slice = slice(None)) -> None:
        """Cut one block: it begins at block * hop, and fades out as the next one fades in.

        Parameters
        ----------
        block : int
            Which.
        hop : int
            Samples from one block to the next.
        fade : int
            Samples over which one fades into the next.
        out : float32 or float64 array, shape (actuators, hop + fade or more)
            Gets the samples, and zeros behind them.
        actuators : slice
            Of which.
        """
        values = self._values[actuators, block * hop : (block + 1) * hop + fade]
        length = values.shape[1]
        out[:, length:] = 0
        samples, single = out[:, :length], out.dtype == np.float32
        if single and not self._early:
            samples[:] = values * self._factor
            samples *= _window(hop, fade, block > 0, 1.0, single)[:length]
            return
        window = _window(hop, fade, block > 0, self._factor, single)[:length]
        if single:
            # Twice as fast as rounding the product.
            samples[:] = values
            samples *= window
        else:
            np.multiply(values, window, out=samples)


@lru_cache(maxsize=8)
def _window(hop: int, fade: int, faded_in: bool, factor: float, single: bool) -> NDArray[Any]:
    """What a block is multiplied with."""
    window = np.ones(hop + fade)
    if fade:
        # From 0 to 1, with next to no frequencies above ten times its inverse length.
        ramp = np.cumsum(np.kaiser(fade, 12.0))
        ramp /= ramp[-1]
        if faded_in:
            window[:fade] = ramp
        window[hop:] = 1.0 - ramp
    return (window * factor).astype(np.float32 if single else np.float64)
