"""The drift of the sentinel position is drawn with the limits of the bank's run."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pyqtgraph
import pytest
from pytestqt.qtbot import QtBot

from wavefocus.acquisition.limits import DriftPoint
from wavefocus.config.limits import DriftLimits
from wavefocus.gui.campaign.position_panel import DriftPlot

LIMITS = DriftLimits(warn_level_db=0.4, stop_level_db=2.0, warn_correlation=0.97, stop_correlation=0.8)


@pytest.mark.parametrize(
    ("level_db", "drawn"),
    [(0.1, [-0.4, 0.0, 0.4]), (1.0, [-2.0, -0.4, 0.0, 0.4, 2.0]), (9.0, [-2.0, -0.4, 0.0, 0.4, 2.0])],
)
def test_given_points_then_the_limits_that_matter_are_drawn_and_in_view(
    qtbot: QtBot, level_db: float, drawn: list[float]
) -> None:
    plot = DriftPlot()
    qtbot.addWidget(plot)
    at = datetime(2026, 11, 26, 2, tzinfo=UTC)
    points = [DriftPoint(at + timedelta(hours=n), n * level_db, 0.1 * n, 1.0, "steady") for n in range(2)]
    plot.show_drift(points, LIMITS)
    level, _, correlation = plot.plots
    lines = [item for item in level.getPlotItem().items if isinstance(item, pyqtgraph.InfiniteLine)]
    assert sorted(float(line.value()) for line in lines) == pytest.approx(drawn)
    low, high = level.getViewBox().viewRange()[1]
    assert low < min(drawn)
    assert high > max(*drawn, level_db)
    lines = [item for item in correlation.getPlotItem().items if isinstance(item, pyqtgraph.InfiniteLine)]
    assert sorted(float(line.value()) for line in lines) == pytest.approx([0.0, 0.03])
