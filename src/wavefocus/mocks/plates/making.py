"""Plates made by name, at a temperature, with a finger on them."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from wavefocus.config.emulation import FINGER_MM
from wavefocus.config.outline import Outline
from wavefocus.mocks.plates import PLATES, Chain, Float64Array, Plate, PlateChange
from wavefocus.mocks.plates.finger import TouchedPlate

OF_NO_PLATE = ("edge", "speed_per_k", "loss_per_k", "finger", "mode_tolerance")
"""Keys that are carried out here; `mode_tolerance`, of earlier versions, has no effect."""


def make_plate(
    name: str, actuator_mm: Float64Array, outline: Outline, chain: Chain, keys: Mapping[str, Any], warmer_k: float = 0.0
) -> Plate:
    """Make a plate by its name and the keys of its table, some kelvin above `REFERENCE_C`. Raises ValueError."""
    own = {key: value for key, value in keys.items() if key not in OF_NO_PLATE}
    kind = PLATES.all()[f"{name}, infinite" if keys.get("edge") == "infinite" else name]
    change = PlateChange(1 + keys.get("speed_per_k", 0.0) * warmer_k, 1 + keys.get("loss_per_k", 0.0) * warmer_k)
    if (finger := keys.get("finger")) is None:
        return kind(actuator_mm, outline, chain, change=change, **own)
    if not outline.contains(finger["place_mm"], FINGER_MM):
        raise ValueError(f"finger.place_mm is {finger['place_mm']}; it must be {FINGER_MM:g} mm within the outline")

    plate = kind(actuator_mm, outline, np.ones_like, change=change, **own)
    if name == "solid":
        own["force_deg"] = own.get("oscillation_deg", 0.0)
    beneath = kind(np.array([finger["place_mm"]]), outline, np.ones_like, change=change, **own)
    return TouchedPlate(plate, beneath, chain, **finger)
