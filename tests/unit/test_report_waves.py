"""Waves in the report: the line along which crosstalk is computed, and banks that lack figures."""

from __future__ import annotations

import numpy as np
import pytest

from rendering.greens.source import GreenArray
from rendering.report.waves import LINE_POINTS, line_of, wave_figures, waves_of, waves_picture
from rendering.scene.model import Scene, Source
from rendering.scene.paths import Line, Point
from rendering.scene.signals import Impulse
from rendering.verify.comparison import FieldComparison

NO_FOCI = {
    "instant": (),
    "waveform_index": np.zeros(0, np.int64),
    "predicted_waveform": np.zeros((0, 5), np.float32),
    "scanned_waveform": np.zeros((0, 5), np.float32),
}


def comparison(**known) -> FieldComparison:
    values = dict.fromkeys(FieldComparison.__dataclass_fields__) | {"sample_rate_hz": 1000.0, "start_s": -0.1}
    return FieldComparison(**(values | NO_FOCI | known))


def grid(columns, rows):
    return np.array([(4.0 * x, 4.0 * y) for y in range(rows) for x in range(columns)])


def test_the_line_is_the_middle_one_and_no_longer_than_needed():
    position_mm = grid(40, 5)
    line = line_of(position_mm, np.ones(200, bool), 4.0)
    assert len(line) == LINE_POINTS
    assert set(position_mm[line, 1]) == {8.0}
    np.testing.assert_allclose(np.diff(position_mm[line, 0]), 4.0)
    assert abs(position_mm[line, 0].mean() - 78.0) < 4.0


def test_a_gap_ends_a_line_and_a_longer_one_beside_the_middle_is_found():
    position_mm = grid(20, 5)
    measured = np.ones(100, bool)
    measured[[2 * 20 + 5, 2 * 20 + 12]] = False
    line = line_of(position_mm, measured, 4.0)
    assert len(line) == 20
    assert set(position_mm[line, 1]) <= {4.0, 12.0}
    assert len(line_of(np.random.default_rng(0).uniform(0, 50, (80, 2)), np.ones(80, bool), 4.0)) < 8


@pytest.mark.parametrize("path", [Line((0, 0), (20, 0)), Point((4, 4))])
def test_a_bank_without_most_figures_still_gives_lines_and_a_picture(path):
    position_mm = grid(3, 2)
    bank = GreenArray(np.random.default_rng(1).standard_normal((6, 2, 30)), position_mm, 1000.0)
    scene = Scene("s", (Source(path, Impulse(), 0.0, 80.0, 4.0),))
    waves = waves_of(scene, bank, comparison(), 4.0)
    assert (waves.travel, waves.crosstalk, waves.scanned) == (None, None, None)
    lines = {one.name: one for one in wave_figures(waves, scene, None)}
    assert lines["Group velocity"].value == lines["Attenuation"].value == "-"
    assert "Not found" in lines["Attenuation"].definition
    assert "Correlation of neighbours" in lines
    assert waves_picture(waves, None).png.startswith(b"\x89PNG")


def test_a_bank_of_one_wave_everywhere_correlates_everywhere():
    green = np.tile(np.random.default_rng(1).standard_normal(30), (40, 2, 1))
    bank = GreenArray(green, grid(20, 2), 1000.0)
    scene = Scene("s", (Source(Line((0, 0), (20, 0)), Impulse(), 0.0, 300.0, 4.0),))
    waves = waves_of(scene, bank, comparison(), 4.0)
    lines = {one.name: one for one in wave_figures(waves, scene, None)}
    assert lines["Correlation of neighbours"].value.startswith("1.00 at")
    # The speed that is nearest to the scene's, and as much at each point from all others as from its own.
    assert [name for name in lines if name.startswith("Crosstalk")] == [
        f"Crosstalk at 32 cm/s, d = {step} mm" for step in (4, 8, 16)
    ]
    assert waves.crosstalk.energy_ratio.max() > 0.1
