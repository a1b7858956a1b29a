"""Several sources, moving and standing, and extended ones as sums: the example of the documentation."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import load_scene

PAGE = Path(__file__).parents[2] / "docs/how-to/render-and-play.md"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    text = PAGE.read_text(encoding="utf-8").split("```toml\n")[1].split("```")[0]
    file = tmp_path_factory.mktemp("scene") / "scene.toml"
    file.write_text(text, encoding="utf-8")
    return load_scene(file)


@pytest.fixture(scope="module")
def bank():
    position_mm = np.array([(x, y) for y in np.arange(-12.0, 45.0, 4.0) for x in np.arange(-44.0, 45.0, 4.0)])
    green = np.random.default_rng(5).standard_normal((len(position_mm), 3, 80)) * np.exp(-np.arange(80) / 20)
    return GreenArray(green, position_mm, 2000.0)


def test_given_a_bar_then_its_points_move_abreast_and_say_the_same(scene, bank):
    bar = replace(scene, sources=scene.sources[:3])
    drive = render_with_report(bar, bank)[0]
    sample, place = drive.focus_sample.reshape(3, 21), bank.position_mm[drive.focus_position].reshape(3, 21, 2)
    assert (sample == sample[0]).all()
    assert (place[:, :, 0] == place[0, :, 0]).all()
    np.testing.assert_array_equal(np.diff(place[:, :, 1], axis=0), 8.0)
    signals = [source.signal.samples(2000.0) for source in bar.sources]
    np.testing.assert_array_equal(signals[0], signals[1])
    np.testing.assert_array_equal(signals[0], signals[2])
