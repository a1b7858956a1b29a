"""A finger that rests on a plate: mass, spring and damper at one place."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from wavefocus.mocks.plates import MAGNET_RADIUS_MM, Chain, Complex64Array, Complex128Array, Plate

_ANGLES = np.pi / 3 * np.arange(6)
DISK_MM = MAGNET_RADIUS_MM * np.concatenate(
    [[[0.0, 0.0]], np.sqrt(2 / 3) * np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])]
)
DISK_WEIGHTS = np.array([1 / 4] + 6 * [1 / 8])
"""Mean over a disk, exact for polynomials of degree 5 (Abramowitz and Stegun 25.4.61)."""


class TouchedPlate(Plate):
    """Any plate with a finger on it, which pushes back with Z times the velocity of the disk that it covers.

    With responses H from actuators s and finger f to places r, it is H_rs - H_rf Z / (1 + Z H_ff) H_fs.

    plate, beneath: The plate, with its actuators and with one actuator in the finger's place; both without a signal
        chain.
    chain: The signal chain.
    place_mm: Where the finger is.
    mass_kg, damping_n_s_m, stiffness_n_m: Of the finger, Z = j w m + d + s / (j w), >= 0.
    """

    name = "touched"

    def __init__(
        self,
        plate: Plate,
        beneath: Plate,
        chain: Chain,
        place_mm: tuple[float, float],
        *,
        mass_kg: float,
        damping_n_s_m: float,
        stiffness_n_m: float,
    ) -> None:
        self._plate, self._beneath, self._chain = plate, beneath, chain
        self._covered_mm = [(float(x), float(y)) for x, y in np.asarray(place_mm) + DISK_MM]
        self.ringing_s = plate.ringing_s
        self._finger = (mass_kg, damping_n_s_m, stiffness_n_m)
        self._pushed_back = lru_cache(6)(self._find_pushed_back)

    def response(
        self, place_mm: tuple[float, float], step_hz: float, bins: int, *, single: bool
    ) -> Complex64Array | Complex128Array:
        response = self._plate.response(place_mm, step_hz, bins, single=False)
        response = response - self._beneath.response(place_mm, step_hz, bins, single=False) * self._pushed_back(
            step_hz, bins
        )
        response *= self._chain(step_hz * np.arange(bins, dtype=np.float64))
        return response.astype(np.complex64) if single else response

    def _find_pushed_back(self, step_hz: float, bins: int) -> Complex128Array:
        """Force of the finger for unit forces of the actuators, (actuators, bins); 0 at 0 Hz."""
        mass_kg, damping, stiffness = self._finger
        angular = 2j * np.pi * step_hz * np.arange(1, bins)
        impedance = (angular * mass_kg + damping + stiffness / angular) / self._plate.unit_force_n
        reached, own = (self._mean(plate, step_hz, bins)[:, 1:] for plate in (self._plate, self._beneath))
        return np.pad(impedance / (1 + impedance * own) * reached, ((0, 0), (1, 0)))

    def _mean(self, plate: Plate, step_hz: float, bins: int) -> NDArray[np.complexfloating]:
        """Velocity of the disk beneath the finger."""
        velocities = [plate.response(place, step_hz, bins, single=False) for place in self._covered_mm]
        return np.asarray(np.tensordot(DISK_WEIGHTS, velocities, axes=1))
