"""Thin plates of glass for the virtual rig.

kappa^2 biharmonic(w) - (kappa / Q) laplacian(w') + w'' = q / (rho h), kappa = sqrt(D / (rho h)): every wave loses the
same share per period, and the modes of a simply supported rectangle all have the quality factor Q. Mode (m, n) rings at
w = kappa pi^2 (m^2/a^2 + n^2/b^2) (Kirchhoff-Love; Timoshenko and Woinowsky-Krieger 1959).
"""

import numpy as np
import scipy

from wavefocus.config.outline import Outline
from wavefocus.mocks.plates import (
    MAGNET_RADIUS_MM,
    PLATES,
    UNCHANGED,
    Chain,
    Complex128Array,
    Float64Array,
    ModalPlate,
    PlateChange,
)

KAPPA_M2_S = 1.57
"""sqrt(D / (rho h)) of 1 mm of glass."""
MASS_KG_M2 = 2.5
_QUALITY = 100.0
HIGHEST_HZ = 8000.0
"""Modes up to here are summed; those beyond move each response by less than 1 % in a band to 500 Hz."""
STRENGTH = 5.0
"""Force of an actuator relative to that on the soft plate, so that the same converters suit both."""


@PLATES.register
class ThinRectangle(ModalPlate):
    """A simply supported rectangle of glass.

    actuator_mm, outline, chain: See `Plate`; the outline is a rectangle. Raises ValueError.
    quality: Quality factor of every mode, > 0, to 1e4: amplitudes decay as exp(-w t / (2 Q)).
    """

    name = "thin"
    unit_force_n = STRENGTH

    def __init__(
        self,
        actuator_mm: Float64Array,
        outline: Outline,
        chain: Chain,
        *,
        quality: float = _QUALITY,
        change: PlateChange = UNCHANGED,
    ) -> None:
        super().__init__(actuator_mm, outline, chain)
        left, bottom, right, top = outline.box_mm
        if outline.area_mm2 < (1 - 1e-6) * (right - left) * (top - bottom):
            raise ValueError('the plate "thin" is a rectangle; set kind = "rectangle" in [surface] of the rig file')
        kappa, quality = KAPPA_M2_S * change.speed**2, quality / max(change.loss, 1e-12)
        self._corner_m = np.array([left, bottom]) / 1e3
        self._sides_m = length_m, width_m = (right - left) / 1e3, (top - bottom) / 1e3
        most = [int(np.sqrt(2 * HIGHEST_HZ / (np.pi * KAPPA_M2_S)) * side) for side in self._sides_m]
        across, along = (part.ravel() for part in np.meshgrid(*(np.arange(1, count + 1) for count in most)))
        hertz = kappa * np.pi / 2 * (np.square(across / length_m) + np.square(along / width_m))
        within = hertz <= HIGHEST_HZ
        self._across, self._along = across[within], along[within]
        self._angular, self._quality = 2 * np.pi * hertz[within], quality
        self.ringing_s = float(np.log(1000.0) * 2 * quality / self._angular.min(initial=np.inf))
        self._modal_mass_kg = MASS_KG_M2 * length_m * width_m / 4
        # Mean of a mode over the disk of an actuator: its value at the centre times a factor of its wave number.
        argument = np.sqrt(self._angular / kappa) * MAGNET_RADIUS_MM / 1e3
        self._force = self._shapes(actuator_mm) * 2 * scipy.special.jv(1, argument) / argument

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
        length_m, width_m = self._sides_m
        return np.asarray(
            np.sin(np.pi * x[:, None] * self._across / length_m) * np.sin(np.pi * y[:, None] * self._along / width_m)
        )
