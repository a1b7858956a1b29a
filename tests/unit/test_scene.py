"""Values that a scene may hold, and the positions that it needs: with them alone it renders as with all."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavefocus.config.scene import Output
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Circle, Line, Point, Polyline
from wavefocus.rendering.scene.scene_rows import scene_rows
from wavefocus.rendering.scene.signals import Impulse, Noise, Sine
from wavefocus.storage.errors import InputError

NAN, INF = float("nan"), float("inf")
RATE_HZ = 10_000.0


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


SPACING_MM = 4.0
GRID_MM = np.array([(x, y) for y in np.arange(-24.0, 25.0, SPACING_MM) for x in np.arange(-40.0, 41.0, SPACING_MM)])
RATE_HZ = 2000.0

places = st.tuples(st.floats(-38.0, 38.0), st.floats(-22.0, 22.0))
paths = st.one_of(
    st.builds(Point, places),
    st.builds(Line, places, places),
    st.builds(Circle, st.just((0.0, 0.0)), st.floats(1.0, 20.0), st.floats(0.1, 2.0), st.floats(0.0, 360.0)),
    st.builds(Polyline, st.lists(places, min_size=2, max_size=4)),
)


def bank(rows=slice(None)):
    """Some rows of a bank; all are doubtful: to judge what lies between them takes longer than a render."""
    status = np.zeros(len(GRID_MM), dtype=np.uint8)
    status[rows] = 4
    values = np.random.default_rng(3).standard_normal((len(GRID_MM), 2, 12))
    return GreenArray(values, GRID_MM, RATE_HZ, status=status)


def scene_of(*sources, kind="nearest"):
    return Scene("one", sources, output=Output(interpolation=kind))


def moving(path, **changes):
    return Source(path, Sine(100.0, 0.2), speed_mm_s=150.0, step_mm=3.3, **changes)


@settings(max_examples=8)
@given(path=paths, kind=st.sampled_from(["nearest", "bilinear"]), method=st.sampled_from(["sampled", "exact"]))
def test_a_bank_of_the_path_s_rows_alone_renders_as_the_whole_bank_does(path, kind, method):
    scene = scene_of(moving(path), kind=kind)
    rows = scene_rows(scene, GRID_MM)
    whole, _ = render_with_report(scene, bank(), method=method)
    partial, _ = render_with_report(scene, bank(rows.path), method=method)
    np.testing.assert_array_equal(partial.drive_v, whole.drive_v)


def test_kernel_interpolation_needs_its_neighbours_too():
    path = Line((-10.0, 1.0), (12.0, 3.0))
    nearest, kernel = (scene_rows(scene_of(moving(path), kind=kind), GRID_MM) for kind in ("nearest", "kernel"))
    assert set(nearest.path) < set(kernel.path)
    distance = np.min(
        np.hypot(*(GRID_MM[:, None] - path.point_at(np.linspace(0, path.length_mm, 99))).transpose(2, 0, 1)), 1
    )
    assert set(np.flatnonzero(distance < 2.5 * SPACING_MM)) <= set(kernel.path)


def test_the_checks_look_at_all_that_is_near_the_path_and_at_no_more():
    rows = scene_rows(scene_of(moving(Point((1.0, 1.0))), moving(Point((31.0, -20.0)))), GRID_MM)
    distance = np.min([np.hypot(*(GRID_MM - at).T) for at in ((1.0, 1.0), (31.0, -20.0))], axis=0)
    assert set(np.flatnonzero(distance < 15.0)) <= set(rows.checks)
    assert distance[rows.checks].max() <= 15.0 + SPACING_MM + 1e-6
    np.testing.assert_array_equal(rows.all, np.union1d(rows.path, rows.checks))
    assert len(rows.path) == 2
    assert len(rows.all) < len(GRID_MM) / 2


def test_one_position_is_enough_for_a_point():
    scene = scene_of(dataclasses.replace(moving(Point((0.0, 0.0))), signal=Noise((50.0, 450.0), 0.05, 1)))
    rows = scene_rows(scene, np.array([[0.0, 0.0]]))
    assert list(rows.path) == [0]
