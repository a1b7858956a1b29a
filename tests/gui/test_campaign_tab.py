"""The Campaign tab: what it follows; its map, and what it shows of a position, by mouse and keyboard."""

import math
import threading
import time
from datetime import UTC, datetime, timedelta

import numpy as np
import pyqtgraph
import pytest
from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QApplication

from tests.gui.conftest import click, drag, pixel, shown_tab, wait
from wavefocus.calibration.estimator.noise_error import bank_noise_error_db
from wavefocus.campaign.status import CampaignStatus, Heartbeat
from wavefocus.config.messages import campaign as events
from wavefocus.config.run import DriftLimits
from wavefocus.gui.campaign import model
from wavefocus.gui.campaign.follower import Follower, LogTail
from wavefocus.gui.campaign.panels import Controls, ProgressRow
from wavefocus.gui.campaign.position_panel import DriftPlot
from wavefocus.gui.campaign.tab import CampaignTab
from wavefocus.gui.surface import raster_of
from wavefocus.storage.bank.ledger import STATUS_WORDS
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.ledger.owner import Owner

AT = datetime(2026, 1, 1, tzinfo=UTC)


def test_a_growing_log_then_only_whole_new_lines_are_read_and_a_replaced_one_anew(tmp_path):
    log, other = tmp_path / "plate.events.jsonl", tmp_path / "other"
    tail = LogTail(log)
    assert tail.read() == ([], False)
    log.write_bytes(b'{"event": "a"}\n{"ev')
    assert tail.read() == ([{"event": "a"}], False)
    assert tail.read() == ([], False)
    with log.open("ab") as file:
        file.write(b'ent": "b"}\n{"torn\n[1]\n{"event": "c"}\n')
    assert tail.read() == ([{"event": "b"}, {"event": "c"}], False)
    other.write_text('{"event": "d"}\n' * 9, encoding="utf-8")
    other.replace(log)
    assert tail.read() == ([{"event": "d"}] * 9, True)
    log.write_text("", encoding="utf-8")
    assert tail.read() == ([], True)


def _said(campaign, *said):
    campaign.add_records([events.Logged(AT, event) for event in said], anew=False)


def _asked(campaign, *, owned, silent=False):
    owner = Owner("here", 7) if owned else None
    at = datetime.now(UTC) - timedelta(seconds=60 if silent else 0)
    campaign.owner, campaign.asked_s = owner, time.monotonic() + 1.0
    campaign.heartbeat = Heartbeat(at, 7, "here", events.State.RUNNING)


def test_given_events_and_an_owner_then_the_state_says_who_measures_and_who_is_gone():
    campaign = model.CampaignModel()
    assert campaign.state().word is model.Extra.NO_BANK
    assert campaign.state(starting=True).word is model.Extra.STARTING
    _asked(campaign, owned=True)
    assert campaign.state().word is model.Extra.PREPARING
    _said(campaign, events.StateChanged(0.0, events.State.RUNNING, "6 positions to do"))
    assert campaign.state() == model.ShownState(events.State.RUNNING, "6 positions to do")
    _said(campaign, events.StateChanged(0.5, events.State.RECOVERING, "no mirror"))
    assert not campaign.state().paused
    campaign.heartbeat = Heartbeat(datetime.now(UTC), 7, "here", events.State.RECOVERING, pause_asked=True)
    assert campaign.state().paused
    _asked(campaign, owned=True, silent=True)
    assert campaign.state().word is model.Extra.SILENT
    _asked(campaign, owned=False)
    assert campaign.state().word is model.Extra.GONE
    _said(campaign, events.StateChanged(1.0, events.State.FINISHED, "every position is committed"))
    assert campaign.state().word is not events.State.RUNNING


AGAIN = {"Start", "Remeasure selected (1)", "Remeasure poor (2)"}


@pytest.mark.parametrize(
    ("word", "left", "buttons"),
    [
        (events.State.RUNNING, 3, {"Pause", "Stop after this position"}),
        (events.State.PAUSED, 3, {"Continue", "Stop after this position"}),
        (events.State.STOPPING, 3, set()),
        (events.State.STOPPED, 3, {"Resume", *AGAIN}),
        (events.State.FINISHED, 0, AGAIN),
        (model.Extra.GONE, 3, {"Resume", *AGAIN}),
        (model.Extra.STARTING, 3, set()),
        (model.Extra.SILENT, 3, {"Stop after this position"}),
    ],
)
def test_given_a_state_then_only_buttons_that_make_sense_can_be_pressed(qtbot, word, left, buttons):
    controls = Controls(dict.fromkeys(("start", "resume", "pause", "stop", "selected", "poor"), lambda: None))
    qtbot.addWidget(controls)
    controls.show_possible(model.ShownState(word), has_run=True, has_bank=True, left=left, selected=1, poor=2)
    assert {action.text() for action in controls.actions_by_name.values() if action.isEnabled()} == buttons


LOST = events.Fault(1.0, "virtual player", "playing", "no answer", "look", 25, 1, retried=True)


def test_given_a_fault_then_it_is_shown_until_that_instrument_works_or_for_good():
    campaign, names = model.CampaignModel(), ("virtual mirror, 250 mrad", "virtual player")
    _said(campaign, events.SessionStarted(0.0, "plate.h5", 6, 3, 0, 6, 60.0, names))
    _said(campaign, events.PositionStarted(0.5, 25, 1, 0.0, 0.0), LOST)
    assert campaign.lines[-1].weight is model.Weight.FAULT
    assert "no answer" in campaign.instrument_faults["virtual player"]
    _said(campaign, events.ReconnectTried(2.0, "player", "virtual player", 1, False, "gone", 1.0, 9.0))
    assert "gone" in campaign.instrument_faults["virtual player"]
    _said(campaign, events.ReconnectTried(3.0, "player", "virtual player", 2, True, "connected", None, None))
    assert campaign.instrument_faults == {}
    _said(campaign, LOST, events.PositionStarted(4.0, 25, 2, 0.0, 0.0))
    _said(campaign, events.PositionCommitted(5.0, 25, 1, 2, 60.0, -60.0, 0, 0))
    assert campaign.instrument_faults == {}
    _said(campaign, events.PositionStarted(6.0, 24, 1, 0.0, 0.0), events.PositionStarted(6.1, 25, 1, 0.0, 0.0), LOST)
    _said(campaign, events.PositionCommitted(7.0, 24, 1, 1, 60.0, -60.0, 0.0, 0.0))  # was being written meanwhile
    _said(campaign, events.StateChanged(7.1, events.State.FAILED, "no answer"))
    _said(campaign, events.SessionEnded(7.2, events.State.FAILED, 25, 30, {}))
    assert campaign.instrument_faults["virtual player"].startswith("playing: no answer")


def test_given_a_week_of_events_then_no_more_than_so_many_lines_are_kept():
    campaign = model.CampaignModel()
    for _ in range(30):
        _said(campaign, *[events.PositionRepeated(0.0, 1, 1, "a burst")] * 1000)
    assert model.KEPT_LINES <= len(campaign.lines) <= 1.1 * model.KEPT_LINES


LATER = (
    {"event": "new_kind", "position": "x"}, {"event": ["of no kind"]}, {},
    {"event": "state_changed", "state": "dancing", "reason": "later", "time_s": 0.0},
    {"event": "position_committed", "position": None, "status": "x"},
)  # fmt: skip


def test_records_of_a_later_version_then_each_is_a_plain_line_and_changes_nothing():
    campaign = model.CampaignModel()
    lines = [model.read_record({"at": AT.isoformat(), **record}) for record in LATER]
    for line, record in zip(lines, LATER, strict=True):
        assert (line.weight, line.at_s) == (model.Weight.DETAIL, AT.timestamp())
        assert all(str(value) in line.text for key, value in record.items() if key != "time_s")
    campaign.add_records(lines, anew=False)
    assert campaign.lines == lines
    assert campaign.state().word is model.Extra.NO_BANK


def test_each_position_has_its_own_figures_per_actuator_and_unmeasured_ones_none():
    snr_db = np.array([[1, 2, 3], [4, 5, np.nan], [0, 0, 0]], np.float32)
    quality = {"snr_db": snr_db, "attempts": np.ones(3, np.float32)}
    found = model.per_position(quality, np.array([True, True, False]))
    np.testing.assert_array_equal(found["snr_db"], np.array([2.0, 4.5, np.nan], np.float32))
    np.testing.assert_array_equal(found["attempts"], np.array([1, 1, np.nan], np.float32))
    assert np.isnan(found["coherence"]).all()


def test_any_grid_then_every_position_has_pixels_but_checks_and_a_click_finds_it():
    square = np.stack(np.meshgrid(np.arange(7.0), np.arange(5.0)), axis=-1).reshape(-1, 2) * 4.0
    shifted = square + np.where(square[:, 1:] % 8 == 0, 0.0, 2.0) * [1, 0]
    for position_mm in (square, shifted, np.array([[3.0, 4.0]])):
        raster = raster_of(position_mm)
        assert set(np.unique(raster.index)) == set(range(len(position_mm) + 1))
        assert [raster.nearest(*point) for point in position_mm.tolist()] == list(range(len(position_mm)))
        assert raster.nearest(1e4, 0.0) == -1
    checked, bare = raster_of(np.vstack([square, [[1.0, 1.0], [9.5, 6.5]]]), [35, 36]), raster_of(square)
    pixels = [int((checked.index == row).sum()) for row in range(37)]
    assert pixels == [*(int((bare.index == row).sum()) for row in range(35)), 0, 0]
    assert checked.nearest(9.5, 6.5) == 36


def test_given_a_disk_that_hangs_then_the_follower_ends_without_waiting_for_it(tmp_path):
    hangs, continues = threading.Event(), threading.Event()

    def hanging(_bank):
        hangs.set()
        continues.wait(60)

    follower = Follower(tmp_path / "plate.h5", lambda _why, _details: None, hanging)
    assert hangs.wait(30)
    follower.end()
    assert not continues.is_set()
    campaign = model.CampaignModel()
    follower.change(campaign, 9)
    assert (campaign.surface, campaign.lines, campaign.asked_s) == (None, [], 0.0)
    continues.set()


def test_a_state_then_a_remaining_time_is_shown_only_while_positions_are_measured(qtbot):
    qtbot.addWidget(row := ProgressRow())
    for state in map(model.ShownState, [*events.State, *model.Extra]):
        for per_hour, left_s in ((120.0, 4.0), (math.nan, math.nan)):
            progress = events.Progress(0.0, 3, 10, 1.0, left_s, left_s, per_hour)
            session = CampaignStatus().after(events.Logged(datetime.now(UTC), progress))
            row.show_progress(5, 12, session, state, "planned: 12 positions")
            known = ["120 positions an hour"] if per_hour == 120.0 else [""]
            words = row.figures.text().split("  ·  ") if state.measuring else known
            assert words[0] == known[0]
            assert any("left" in one for one in words) is (state.word is events.State.RUNNING and per_hour == 120.0)
            assert (row.bar.value(), row.bar.maximum()) == ((3, 10) if state.measuring else (5, 12))


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
    assert panel.actuators.item(2, 1).text() == f"{snr_db:.1f}"
    assert panel.actuators.item(2, 5).text() == f"{error_db[6, 2]:.1f}"
    tab.window().resize(1240, 720)
    for page in range(panel.count()):
        panel.setCurrentIndex(page)
        QApplication.processEvents()
    for plot in (panel.green_plot, panel.spectrum_plot, panel.drift_plot.plots[0]):  # no title is cut
        assert 0 < plot.getPlotItem().titleLabel.itemRect().width() < plot.width()
    tab.window().resize(1280, 800)


def test_arrow_keys_clicks_or_drags_then_the_map_is_walked_and_positions_selected(qtbot, tab):
    shown = tab.map_panel.map
    right, up, left, down = Qt.Key.Key_Right, Qt.Key.Key_Up, Qt.Key.Key_Left, Qt.Key.Key_Down
    for key, position in zip(  # from the middle of the grid
        (right, right, up, left, left, left, down, down), (5, 6, 10, 9, 8, 8, 4, 0), strict=True
    ):
        qtbot.keyClick(shown, key)
        assert shown.marked == position
    qtbot.keyClick(shown, Qt.Key.Key_Space)
    assert shown.selected == {0}
    qtbot.keyClick(shown, Qt.Key.Key_A, Qt.KeyboardModifier.ControlModifier)
    assert shown.selected == set(range(12))
    qtbot.keyClick(shown, Qt.Key.Key_Escape)
    assert shown.selected == set()
    shown.box.setRange(xRange=(-2, 7), yRange=(-2, 5))
    for at_mm in ((0, 0), (4.5, 3), (3, 1.5), (3, 1.5)):  # the last click hits the mark of the one before
        click(shown, pixel(shown, *at_mm), Qt.KeyboardModifier.ControlModifier)
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
    words = {look.word: look.bit for look in model.LOOKS if look.bit not in (0, model.DAMAGED)}
    assert words == {word: int(bit) for word, bit in STATUS_WORDS.items() if bit}


def test_given_a_weight_or_a_position_then_only_its_events_are_listed(qtbot, tab):
    events = tab.events

    def shown():
        return [row for row in range(events.view.rowCount()) if not events.view.isRowHidden(row)]

    notes = len(shown())
    events.weight.setCurrentIndex(0)
    assert len(shown()) == len(tab.campaign.lines) > notes > 0
    row = next(row for row in shown() if "position 7 is measured" in events.view.item(row, 2).text())
    events.view.doubleClicked.emit(events.view.model().index(row, 2))
    assert tab.map_panel.map.marked == 7
    events.of_position.click()
    tab.map_panel.map.show_position(3)
    texts = [events.view.item(row, 2).text() for row in shown()]
    assert texts
    assert all("position 3 " in text for text in texts)


def test_given_points_then_limits_of_a_stop_that_are_near_are_drawn_and_in_view(qtbot):
    at = datetime(2026, 11, 26, 2, tzinfo=UTC)
    for level_db, drawn in ((0.1, [0.0]), (0.4, [0.0]), (1.0, [-2.0, 0.0, 2.0]), (9.0, [-2.0, 0.0, 2.0])):
        qtbot.addWidget(plot := DriftPlot())
        looks = [(n * level_db, 0.1 * n, 1.0, "steady", "run", "", ()) for n in range(2)]
        points = [(at + timedelta(hours=n), events.Drift(0.0, 0, *look)) for n, look in enumerate(looks)]
        plot.show_drift(points, DriftLimits(warn_level_db=0.2, stop_level_db=2.0, stop_correlation=0.8))
        level, correlation = (
            [one.value() for one in part.getPlotItem().items if isinstance(one, pyqtgraph.InfiniteLine)]
            for part in plot.plots[::2]
        )
        assert sorted(level) == pytest.approx(drawn)
        low, high = plot.plots[0].getViewBox().viewRange()[1]
        assert low < min(drawn)
        assert high > max(*drawn, level_db)
        assert correlation == [0.0]
