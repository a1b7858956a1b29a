"""The interpolation that a scene asks for, over the bank that it is rendered from."""

from __future__ import annotations

from importlib import import_module

import numpy as np
from numpy.typing import NDArray

from config.interpolations import INTERPOLATIONS
from rendering.greens.interpolation.base import Interpolation
from rendering.greens.source import GreenSource
from rendering.scene.model import Scene
from storage.errors import InputError

Float64Array = NDArray[np.float64]

POINTS_PER_SOURCE = 64


def interpolation_method(name: str) -> type[Interpolation]:
    """Load a registered method; raises InputError where there is none of that name."""
    if name not in INTERPOLATIONS:
        raise InputError(f"interpolation is {name!r}; allowed are {', '.join(INTERPOLATIONS)}")
    module, _, method = INTERPOLATIONS[name].partition(":")
    found: type[Interpolation] = getattr(import_module(module), method)
    return found


def scene_interpolation(scene: Scene, bank: GreenSource) -> Interpolation:
    """Make the interpolation of a scene; raises InputError where the bank's positions do not allow it."""
    return interpolation_method(scene.output.interpolation).over(bank, scene_points(scene))


def scene_points(scene: Scene, most: int = POINTS_PER_SOURCE) -> Float64Array:
    """Points evenly chosen along the paths of a scene's sources, at most so many each, float64 (n, 2)."""
    parts = []
    for source in scene.sources:
        length_mm = source.path.length_mm
        parts.append(source.path.point_at(np.linspace(0.0, length_mm, most) if length_mm > 0 else np.zeros(1)))
    return np.concatenate(parts)
