"""The interpolation that a scene asks for, over the bank that it is rendered from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rendering.greens.interpolation.methods import Interpolation, interpolation
from rendering.greens.interpolation.position_grid import PositionGrid
from rendering.greens.source import GreenSource
from rendering.scene.model import Scene

Float64Array = NDArray[np.float64]

POINTS_PER_SOURCE = 64


def scene_interpolation(scene: Scene, bank: GreenSource) -> Interpolation:
    """Make the interpolation of a scene.

    Parameters
    ----------
    scene : Scene
        What is to be rendered.
    bank : GreenSource
        The bank.

    Raises
    ------
    InputError
        The kind is unknown, or the bank's positions do not allow it.
    """
    if scene.output.interpolation == "kernel":
        # The only one who needs it; other scenes shall not wait for its imports.
        from rendering.greens.interpolation.kernel import KernelInterpolation

        return KernelInterpolation(bank, scene_points(scene))
    return interpolation(scene.output.interpolation, PositionGrid(bank.position_mm))


def scene_points(scene: Scene, most: int = POINTS_PER_SOURCE) -> Float64Array:
    """Points evenly chosen along the paths of a scene's sources, at most so many each, float64 (n, 2)."""
    parts = []
    for source in scene.sources:
        length_mm = source.path.length_mm
        parts.append(source.path.point_at(np.linspace(0.0, length_mm, most) if length_mm > 0 else np.zeros(1)))
    return np.concatenate(parts)
