"""Plates made by name, at a temperature, and with a finger on them: mass, spring and damper at one place."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.config.emulation import FINGER_MM
from wavefocus.config.outline import Outline
from wavefocus.mocks.plates import (
    MAGNET_RADIUS_MM,
    PLATES,
    Chain,
    Complex64Array,
    Complex128Array,
    Float64Array,
    Plate,
    PlateChange,
)

_OF_NO_PLATE = ("speed_per_k", "loss_per_k", "finger", "loss", "edge", "mode_tolerance")
"""Keys that are carried out here, and those of earlier versions, which have no effect."""


def make_plate(
    name: str, actuator_mm: Float64Array, outline: Outline, chain: Chain, keys: Mapping[str, Any], warmer_k: float = 0.0
) -> Plate:
    """Make a plate by its name and the keys of its table, some kelvin above `REFERENCE_C`. Raises ValueError."""
    own = {key: value for key, value in keys.items() if key not in _OF_NO_PLATE}
    kind: type[Plate] = PLATES.all()[name]
    change = PlateChange(1 + keys.get("speed_per_k", 0.0) * warmer_k, 1 + keys.get("loss_per_k", 0.0) * warmer_k)
    if (finger := keys.get("finger")) is None:
        return kind(actuator_mm, outline, chain, change=change, **own)
    if not outline.contains(finger["place_mm"], FINGER_MM):
        raise ValueError(f"finger.place_mm is {finger['place_mm']}; it must be {FINGER_MM:g} mm within the outline")

    plate = kind(actuator_mm, outline, np.ones_like, change=change, **own)
    if name == "solid":
        own["force_deg"] = own.get("oscillation_deg", 0.0)
    beneath = kind(np.array([finger["place_mm"]]), outline, np.ones_like, change=change, **own)
    return _TouchedPlate(plate, beneath, chain, **finger)


_ANGLES = np.pi / 3 * np.arange(6)
DISK_MM = MAGNET_RADIUS_MM * np.concatenate(
    [[[0.0, 0.0]], np.sqrt(2 / 3) * np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])]
)
DISK_WEIGHTS = np.array([1 / 4] + 6 * [1 / 8])
"""Mean over a disk, exact for polynomials of degree 5 (Abramowitz and Stegun 25.4.61)."""


class _TouchedPlate(Plate):
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
