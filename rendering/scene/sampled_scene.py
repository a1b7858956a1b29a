"""All sources of a scene, sampled over a bank."""

from __future__ import annotations

from rendering.greens.between_positions import scene_interpolation
from rendering.greens.interpolation import Interpolation
from rendering.greens.source import GreenSource
from rendering.scene.model import Scene
from rendering.scene.sampling import Method, SampledSource, point_count, sample_source
from rendering.scene.scene_size import check_scene_size


def sample_scene(scene: Scene, bank: GreenSource, method: Method) -> tuple[Interpolation, list[SampledSource]]:
    """Sample the sources of a scene, once its size is found to be within the limits.

    Parameters
    ----------
    scene : Scene
        The scene.
    bank : GreenSource
        Its rate, length, positions and, for some interpolations, its Green's functions.
    method : {"sampled", "exact"}
        As for `rendering.scene.sampling.sample_source`.

    Raises
    ------
    InputError
        The scene is larger than allowed, or does not fit the bank.
    """
    rate_hz, taps = float(bank.sample_rate_hz), bank.taps
    for index, source in enumerate(scene.sources):
        point_count(source, index)
    check_scene_size(scene, sample_rate_hz=rate_hz, taps=taps, actuators=bank.actuators)
    kind = scene_interpolation(scene, bank)
    sources = [
        sample_source(source, index, kind, sample_rate_hz=rate_hz, taps=taps, method=method)
        for index, source in enumerate(scene.sources)
    ]
    return kind, sources
