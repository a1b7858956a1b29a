"""Nodes along a path: smooth functions of arc length come back from them."""

from __future__ import annotations

import numpy as np
import pytest

from rendering.greens.interpolation.kernel import PathNodes, node_spacing_mm
from rendering.scene.paths import Circle, Line, Polyline, Strokes


def interpolated(nodes, values, along):
    index, weights = nodes.weights(along)
    return (values[index] * weights).sum(axis=1)


def wave(points_mm, k=0.6, direction=0.4):
    return np.exp(-1j * k * (points_mm @ [np.cos(direction), np.sin(direction)]))


@pytest.mark.parametrize("error", [1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize("path", [Line((0.0, 0.0), (50.0, 0.0)), Circle((3.0, -2.0), 30.0, 1.7, 10.0)])
def test_a_wave_along_the_path_comes_back_with_the_error_asked_for(path, error):
    k = 0.6
    nodes = PathNodes(path, node_spacing_mm(k, error))
    along = np.linspace(0.0, path.length_mm, 3001)
    values = wave(path.point_at(nodes.arc_length_mm), k, 0.0)
    found = interpolated(nodes, values, along)
    rms = np.sqrt(np.mean(np.abs(found - wave(path.point_at(along), k, 0.0)) ** 2))
    assert 0.2 * error < rms < 1.3 * error


def test_weights_sum_to_one_and_are_exact_on_a_node():
    nodes = PathNodes(Polyline([(0.0, 0.0), (10.0, 0.0), (10.0, 0.3), (14.0, 0.3)]), 0.7)
    index, weights = nodes.weights(np.linspace(0.0, 14.3, 400))
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    index, weights = nodes.weights(nodes.arc_length_mm[1:9])
    at = index[np.arange(8), np.argmax(np.abs(weights), axis=1)]
    np.testing.assert_array_equal(at, np.arange(1, 9))


def test_corners_and_gaps_are_not_interpolated_across():
    square = Polyline([(0.0, 0.0), (20.0, 0.0), (20.0, 20.0), (0.0, 20.0)], closed=True)
    strokes = Strokes([np.array([[0.0, 0.0], [15.0, 0.0]]), np.array([[5.0, 9.0], [5.0, -9.0]])])
    for path in (square, strokes):
        nodes = PathNodes(path, node_spacing_mm(0.6, 1e-3))
        along = np.linspace(0.0, path.length_mm, 5003)[1:-1]
        found = interpolated(nodes, wave(path.point_at(nodes.arc_length_mm)), along)
        assert np.abs(found - wave(path.point_at(along))).max() < 5e-3


def test_turns_of_a_circle_share_their_nodes():
    once, five = (PathNodes(Circle((0.0, 0.0), 10.0, turns), 0.8) for turns in (1.0, 5.0))
    points = Circle((0.0, 0.0), 10.0, 5.0).point_at(five.arc_length_mm)
    assert len(np.unique(np.round(points, 6), axis=0)) == len(once.arc_length_mm) - 1


@pytest.mark.parametrize("length_mm", [1e-4, 0.5, 0.8, 1.5, 2.3])
def test_a_path_shorter_than_four_nodes_takes_what_there_is(length_mm):
    path = Line((0.0, 0.0), (length_mm, 0.0))
    nodes = PathNodes(path, 0.8)
    along = np.linspace(0.0, length_mm, 11)
    found = interpolated(nodes, 2.0 + 3.0 * nodes.arc_length_mm, along)
    np.testing.assert_allclose(found, 2.0 + 3.0 * along, atol=1e-12)
