"""The map and what it shows of a position, by mouse and by keyboard."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pyqtgraph
import pytest
from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QApplication

from tests.gui.conftest import click, drag, pixel, shown_tab, wait
from wavefocus.acquisition.limits import DriftPoint
from wavefocus.calibration.estimator.noise_error import bank_noise_error_db
from wavefocus.config.run import DriftLimits
from wavefocus.gui.campaign.model import DAMAGED, LOOKS
from wavefocus.gui.campaign.position_panel import DriftPlot
from wavefocus.gui.campaign.tab import CampaignTab
from wavefocus.storage.bank.ledger import STATUS_WORDS
from wavefocus.storage.bank.reading import open_bank

CTRL = Qt.KeyboardModifier.ControlModifier


@pytest.fixture
def tab(qtbot, shared_window, measured):
    """The Campaign tab with the measured bank; nothing is shown of a position, and none is selected."""
    tab = shown_tab(shared_window, CampaignTab)
    tab.follow(measured / "plate.h5")
    wait(qtbot, lambda: tab.campaign.surface is not None and len(tab.campaign.lines) > 0)
    tab.draw()
    tab.map_panel.map.show_position(-1)
    tab.map_panel.map.select([])
    tab.map_panel.map.box.autoRange()
    QApplication.processEvents()
    return tab


def test_click_on_map_then_green_s_functions_and_quality_of_that_position_are_shown(qtbot, tab):
    panel, shown = tab.position_panel, tab.map_panel.map
    click(shown, pixel(shown, 3.0, 1.5))
    for plot in (panel.green_plot, panel.spectrum_plot):
        assert "position 6" in plot.getPlotItem().titleLabel.text  # and no more "click a position"
    wait(qtbot, lambda: panel.greens is not None and panel.greens.position == 6)
    with open_bank(tab.campaign.surface.bank) as bank:
        np.testing.assert_array_equal(panel.greens.green, bank.green(6))
        snr_db = bank.quality["snr_db"][6, 2]
        error_db = bank_noise_error_db(bank)
        assert error_db is not None
    assert panel.actuators.item(2, 1).text() == f"{snr_db:.1f}"
    assert panel.actuators.item(2, 5).text() == f"{error_db[6, 2]:.1f}"
    tab.window().resize(1240, 720)
    for page in range(panel.count()):
        panel.setCurrentIndex(page)
        QApplication.processEvents()
    for plot in (panel.green_plot, panel.spectrum_plot, panel.drift_plot.plots[0]):  # no title is cut
        assert 0 < plot.getPlotItem().titleLabel.itemRect().width() < plot.width()
    panel.actuator.setCurrentIndex(2)
    tab.window().resize(1280, 800)
    assert "position 6: actuator 1" in panel.spectrum_plot.getPlotItem().titleLabel.text


def test_arrow_keys_and_space_then_the_map_is_walked_and_selected_without_a_mouse(qtbot, tab):
    shown = tab.map_panel.map
    for key, position in (
        (Qt.Key.Key_Right, 5),  # the middle of the grid
        (Qt.Key.Key_Right, 6),
        (Qt.Key.Key_Up, 10),
        (Qt.Key.Key_Left, 9),
        (Qt.Key.Key_Left, 8),
        (Qt.Key.Key_Left, 8),
        (Qt.Key.Key_Down, 4),
        (Qt.Key.Key_Down, 0),
    ):
        qtbot.keyClick(shown, key)
        assert shown.shown == position
    qtbot.keyClick(shown, Qt.Key.Key_Space)
    assert shown.selected == {0}
    qtbot.keyClick(shown, Qt.Key.Key_A, CTRL)
    assert shown.selected == set(range(12))


def test_given_ctrl_clicks_and_a_rectangle_then_those_positions_are_selected(qtbot, tab):
    shown = tab.map_panel.map
    shown.box.setRange(xRange=(-2, 7), yRange=(-2, 5))
    for at_mm in ((0, 0), (4.5, 3), (3, 1.5), (3, 1.5)):  # the last click hits the mark of the one before
        click(shown, pixel(shown, *at_mm), CTRL)
    assert shown.selected == {0, 11}
    drag(qtbot, shown, [pixel(shown, -1, -1), pixel(shown, 2, 2)], Qt.KeyboardModifier.ShiftModifier)
    assert shown.selected == {0, 1, 4, 5}
    tab.draw()
    assert tab.controls.actions_by_name["selected"].text() == "Remeasure selected (4)"


def test_a_figure_then_the_colour_bar_names_its_unit_and_spans_what_the_bank_holds(qtbot, tab):
    tab.map_panel.colour_by.setCurrentIndex(1)
    with open_bank(tab.campaign.surface.bank) as bank:
        snr_db = np.median(bank.quality["snr_db"], axis=1)
    np.testing.assert_allclose(tab.map_panel.levels, (snr_db.min(), snr_db.max()), rtol=1e-6)
    assert "(dB)" in tab.map_panel.bar.accessibleName()
    tab.map_panel.colour_by.setCurrentIndex(0)
    assert tab.map_panel.levels is None
    words = {look.word: look.bit for look in LOOKS if look.bit not in (0, DAMAGED)}
    assert words == {word: int(bit) for word, bit in STATUS_WORDS.items() if bit}


def test_given_a_filter_then_only_events_of_that_weight_with_those_words_are_listed(qtbot, tab):
    events = tab.events
    notes = events.lines.rowCount()
    events.weight.setCurrentIndex(0)
    assert events.lines.rowCount() == len(tab.campaign.lines) > notes > 0
    qtbot.keyClicks(events.text, "position 7 is measured")
    assert events.lines.rowCount() == 1
    events.view.doubleClicked.emit(events.lines.index(0, 2))
    assert tab.map_panel.map.shown == 7
    events.text.clear()
    events.of_position.click()
    tab.map_panel.map.show_position(3)
    shown = [events.lines.index(row, 2).data() for row in range(events.lines.rowCount())]
    assert shown
    assert all("position 3 " in text for text in shown)


LIMITS = DriftLimits(warn_level_db=0.4, stop_level_db=2.0, warn_correlation=0.97, stop_correlation=0.8)


@pytest.mark.parametrize(
    ("level_db", "drawn"),
    [(0.1, [-0.4, 0.0, 0.4]), (1.0, [-2.0, -0.4, 0.0, 0.4, 2.0]), (9.0, [-2.0, -0.4, 0.0, 0.4, 2.0])],
)
def test_given_points_then_the_limits_that_matter_are_drawn_and_in_view(qtbot, level_db, drawn):
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
