"""Which grid a band needs: advice that a plan gives, held against interpolation itself elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from wavefocus.acquisition.grid import surface_grid
from wavefocus.commands.plan import Waves, advice_lines, grid_advice, top_hz_of
from wavefocus.config.outline import Outline
from wavefocus.config.scene import Output
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Line, Point
from wavefocus.rendering.scene.signals import Noise, Sine

GRID_MM = surface_grid(Outline.stadium(250.0, 150.0), 14.3, 4.0)
POSITION_S = 74.4


def scene(signal) -> Scene:
    return Scene("one", (Source(Point((0.0, 0.0)), signal),), output=Output())


def test_a_lower_band_needs_a_wider_grid_and_fewer_hours():
    high, low = (grid_advice(GRID_MM, POSITION_S, top_hz=top_hz, waves=Waves()) for top_hz in (500.0, 300.0))
    for one, other in zip(high, low, strict=True):
        assert other.spacing_mm > 1.3 * one.spacing_mm
        assert other.positions < 0.6 * one.positions
        assert one.duration_s == pytest.approx(one.positions * POSITION_S)
    spacing_mm = {(one.interpolation, one.lattice): one.spacing_mm for one in high}
    assert spacing_mm["bicubic", "square"] < spacing_mm["kernel", "square"] < spacing_mm["kernel", "hexagonal"]


def test_the_area_is_that_of_the_plan():
    whole = grid_advice(GRID_MM, POSITION_S, top_hz=500.0, waves=Waves())
    half = grid_advice(GRID_MM[GRID_MM[:, 0] > 0], POSITION_S, top_hz=500.0, waves=Waves())
    assert half[0].positions == pytest.approx(whole[0].positions / 2, rel=0.01)


def test_a_scene_s_band_ends_where_its_signals_do_and_no_later_than_the_sweep():
    assert top_hz_of([scene(Sine(200.0, 0.5))], 10_000.0, 500.0) == pytest.approx(200.0, abs=10.0)
    assert top_hz_of([scene(Noise((150.0, 300.0), 0.5, 1))], 10_000.0, 500.0) == pytest.approx(300.0, abs=10.0)
    assert top_hz_of([scene(Sine(900.0, 0.5))], 10_000.0, 500.0) == 500.0
    line = Source(Line((0.0, 0.0), (9.0, 0.0)), Sine(250.0, 0.5), speed_mm_s=80.0, step_mm=4.0)
    both = [scene(Sine(100.0, 0.5)), Scene("two", (line,), output=Output())]
    assert top_hz_of(both, 10_000.0, 500.0) == pytest.approx(250.0, abs=10.0)


def test_lines_say_kind_spacing_positions_and_the_hours_saved_or_added():
    advice = grid_advice(GRID_MM, POSITION_S, top_hz=300.0, waves=Waves())
    lines = advice_lines(advice, top_hz=300.0, waves=Waves(), planned_s=len(GRID_MM) * POSITION_S)
    assert "300 Hz" in lines[0]
    assert len(lines) == 4
    assert "kernel, hexagonal" in lines[3]
    assert lines[3].endswith("less)")
    tight = advice_lines(advice, top_hz=300.0, waves=Waves(), planned_s=0.0)
    assert all(line.endswith("more)") for line in tight[1:])
    assert np.isfinite([one.spacing_mm for one in advice]).all()
