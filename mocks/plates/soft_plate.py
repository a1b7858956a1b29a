"""The infinite soft plate of the virtual rig: a scalar wave, damped or with the loss of a springpot."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from config.outline import Outline
from mocks.plates import PLATES, UNCHANGED, Change
from mocks.plates.infinite import Colour, InfinitePlate
from mocks.plates.soft import MAGNET_RADIUS_MM, SOFT_PLATE, SPRINGPOT_PLATE, UNIT_FORCE_N

Float64Array = NDArray[np.float64]


@PLATES.register
class SoftPlate(InfinitePlate):
    """A gel plate without a rim, fitted to the paper's group velocity and attenuation.

    Parameters
    ----------
    actuator_mm, outline, chain
        As of every plate.
    loss : str
        ``"damped"``: nearly the same at all frequencies; ``"springpot"``: growing with frequency.
    """

    name = "soft"

    unit_force_n = UNIT_FORCE_N

    def __init__(
        self,
        actuator_mm: Float64Array,
        outline: Outline,
        chain: Colour,
        *,
        loss: str = "damped",
        change: Change = UNCHANGED,
    ) -> None:
        self._wave = (SPRINGPOT_PLATE if loss == "springpot" else SOFT_PLATE).changed(change)
        super().__init__(actuator_mm, outline, change.softened(chain), (self._wave,))

    def weights(self, gap_mm: Float64Array) -> None:
        return None

    def loudness(self, frequency_hz: Float64Array) -> Float64Array:
        wavenumber = self._wave.wavenumber(frequency_hz)
        argument = wavenumber * MAGNET_RADIUS_MM / 1e3
        return np.asarray(
            np.abs(2 * scipy.special.jv(1, argument) / argument) * frequency_hz / np.sqrt(np.abs(wavenumber))
        )
