"""What a scene may say."""

from __future__ import annotations

import pytest

from rendering.scene.model import Scene, Source
from rendering.scene.paths import Line, Point
from rendering.scene.signals import Impulse
from storage.errors import InputError

NAN, INF = float("nan"), float("inf")


def test_a_point_needs_neither_speed_nor_step():
    source = Source(Point((1.0, 2.0)), Impulse(), speed_mm_s=-5.0, step_mm=NAN)
    assert source.emission == "continuous"
    assert source.amplitude == 1.0


@pytest.mark.parametrize(
    ("figure", "value"),
    [
        ("start_s", -0.1),
        ("start_s", NAN),
        ("amplitude", INF),
        ("emission", "once"),
        ("speed_mm_s", -1.0),
        ("speed_mm_s", NAN),
        ("step_mm", -4.0),
        ("step_mm", INF),
    ],
)
def test_a_source_with_a_figure_out_of_range_is_refused_by_name(figure, value):
    figures = {"speed_mm_s": 80.0, "step_mm": 4.0, figure: value}
    with pytest.raises(InputError, match=f"{figure} is "):
        Source(Line((0, 0), (10, 0)), Impulse(), **figures)


def test_a_scene_without_a_source_is_refused():
    with pytest.raises(InputError, match="no source"):
        Scene("empty", ())
