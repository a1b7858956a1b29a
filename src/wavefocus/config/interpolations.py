"""Interpolation methods of a bank between its positions, by the name that a scene file gives them.

A new method is a class in rendering/greens/interpolation/, an entry here, and a line of the table in
tests/unit/test_interpolation.py.
"""

INTERPOLATIONS = {
    "nearest": "wavefocus.rendering.greens.interpolation.on_grid:Nearest",
    "bilinear": "wavefocus.rendering.greens.interpolation.on_grid:Bilinear",
    "kernel": "wavefocus.rendering.greens.interpolation.kernel:KernelInterpolation",
    "waves": "wavefocus.rendering.greens.interpolation.waves:WavesInterpolation",
    "auto": "wavefocus.rendering.greens.interpolation.auto:scene_choice",
}
