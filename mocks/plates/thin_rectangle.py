"""The thin plate of the virtual rig: a simply supported rectangle of glass, as a sum over its modes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from config.outline import Outline
from mocks.plates import PLATES, Complex128Array
from mocks.plates.modal import ModalPlate
from mocks.plates.soft import MAGNET_RADIUS_MM
from mocks.plates.thin import ThinPlate

Float64Array = NDArray[np.float64]

KAPPA_M2_S = 1.57
"""sqrt(D / (rho h)) of 1 mm of glass."""
HIGHEST_HZ = 8000.0
"""Modes up to here are summed; those beyond move each response by less than 1 % in a band to 500 Hz."""
STRENGTH = 5.0
"""Force of an actuator relative to that on the soft plate, so that the same converters suit both."""


@PLATES.register
class ThinRectangle(ModalPlate):
    """A simply supported rectangle of 1 mm of glass (Kirchhoff-Love; Timoshenko and Woinowsky-Krieger 1959).

    Parameters
    ----------
    actuator_mm, outline, chain
        As of every plate; the outline is a rectangle. Raises ValueError.
    quality : float
        Quality factor of every mode, > 0, to 1e4: amplitudes decay as exp(-w t / (2 Q)).
    """

    name = "thin"

    def __init__(
        self,
        actuator_mm: Float64Array,
        outline: Outline,
        chain: Callable[[Float64Array], Complex128Array],
        *,
        quality: float = 100.0,
    ) -> None:
        super().__init__(actuator_mm, outline, chain)
        if not (np.isfinite(quality) and quality > 0):
            raise ValueError(f"quality is {quality}; it must be finite and greater than 0")
        left, bottom, right, top = outline.box_mm
        if outline.area_mm2 < (1 - 1e-6) * (right - left) * (top - bottom):
            raise ValueError('the plate "thin" is a rectangle; set kind = "rectangle" in [surface] of the rig file')
        self._corner_m = np.array([left, bottom]) / 1e3
        self._plate = plate = ThinPlate((right - left) / 1e3, (top - bottom) / 1e3, KAPPA_M2_S)
        most = [int(np.sqrt(2 * HIGHEST_HZ / (np.pi * KAPPA_M2_S)) * side) for side in (plate.length_m, plate.width_m)]
        across, along = (part.ravel() for part in np.meshgrid(*(np.arange(1, count + 1) for count in most)))
        hertz = plate.mode_hz(across, along)
        within = hertz <= HIGHEST_HZ
        self._across, self._along = across[within], along[within]
        self._angular, self._quality = 2 * np.pi * hertz[within], quality
        self._modal_mass_kg = plate.mass_kg_m2 * plate.length_m * plate.width_m / 4
        # Mean of a mode over the disk of an actuator: its value at the centre times a factor of its wave number.
        from scipy.special import jv

        argument = np.sqrt(self._angular / KAPPA_M2_S) * MAGNET_RADIUS_MM / 1e3
        self._force = self._shapes(actuator_mm) * 2 * jv(1, argument) / argument

    def coefficients(self, place_mm: Float64Array) -> Float64Array:
        return np.asarray(self._shapes(place_mm)[:, None, :] * self._force)

    def mode_velocities(self, frequency_hz: Float64Array) -> Complex128Array:
        angular = 2 * np.pi * np.asarray(frequency_hz, dtype=np.float64)
        own = self._angular[:, None]
        stiffness = own**2 - angular**2 + 1j * angular * own / self._quality
        return np.asarray(STRENGTH * 1j * angular / (self._modal_mass_kg * stiffness))

    def _shapes(self, place_mm: Float64Array) -> Float64Array:
        """Shapes of all modes at places (n, 2): (n, modes)."""
        x, y = (np.asarray(place_mm, dtype=np.float64) / 1e3 - self._corner_m).T
        plate = self._plate
        return np.asarray(
            np.sin(np.pi * x[:, None] * self._across / plate.length_m)
            * np.sin(np.pi * y[:, None] * self._along / plate.width_m)
        )
