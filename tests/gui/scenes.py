"""Scenes that tests of the window draw."""

from __future__ import annotations

from typing import Any

from config.scene import LineTable, Output, SceneConfig, SceneTable, SineTable, SourceTable


def line_scene(end_mm: float = 4.5, amplitude: float = 1.0, step_mm: float = 1.5, **output: Any) -> SceneConfig:
    """A sine of 150 Hz that moves along the first row of the measured bank."""
    source = SourceTable(
        path=LineTable(start_mm=(0.0, 0.0), end_mm=(end_mm, 0.0)),
        signal=SineTable(frequency_hz=150.0, duration_s=0.2),
        speed_mm_s=30.0,
        step_mm=step_mm,
        amplitude=amplitude,
    )
    return SceneConfig(scene=SceneTable(name="line"), source=(source,), output=Output(**output))
