"""Errors of threads, a follower that fails, size, message bar, what is remembered, and lines without ripple."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pytestqt.qtbot import QtBot

from tests.gui.conftest import Opens, campaign_of, tab_of, wait, write_lab
from wavefocus.campaign.control import read_heartbeat
from wavefocus.gui.campaign.follower import Follower
from wavefocus.gui.field_map import MAX_COLUMNS, decimate
from wavefocus.gui.scene.tab import SceneTab


def test_defect_while_bank_is_followed_then_window_says_so_and_goes_on_following(
    qtbot: QtBot, open_window: Opens, finished: Path
) -> None:
    broken = [True]
    window = open_window()
    tab = campaign_of(window)
    tab.bank_field.show_path(finished)
    tab.follower = Follower(finished, lambda bank: 1 / 0 if broken else read_heartbeat(bank))
    wait(qtbot, lambda: "is not followed" in window.messages.sentence)
    assert [button.text() for button in window.messages.buttons()] == ["Copy details"]
    broken.clear()
    wait(qtbot, lambda: tab.campaign.trouble[0] == "")
    assert window.messages.sentence == ""


def test_given_another_run_file_then_the_bank_of_the_former_one_is_let_go(
    qtbot: QtBot, open_window: Opens, finished: Path, tmp_path: Path
) -> None:
    run_file, other = finished.with_name("run.toml"), write_lab(tmp_path / "other", 2, 2)
    window = open_window(run_file)
    tab = campaign_of(window)
    wait(qtbot, lambda: tab.campaign.measured == 12)
    window.messages.warn("something about the first run")
    window.open_file(other)
    assert tab.bank_field.path == other.with_name("plate.h5")
    assert window.messages.sentence == ""
    wait(qtbot, lambda: tab.campaign.surface is None)
    window.open_file(finished)
    window.open_file(other)  # the same run again: the bank that was chosen stays
    assert tab.bank_field.path == finished


def test_given_virtual_typed_as_a_rig_then_it_stays_a_word(qtbot: QtBot, open_window: Opens) -> None:
    window = open_window()
    scene = tab_of(window, SceneTab)
    window._pages.setCurrentWidget(scene)
    bar = scene.results.bar
    for text, rig in (("virtual", "virtual"), ("rig.toml", str(Path("rig.toml").absolute())), ("virtual", "virtual")):
        bar.rig_field.line.setText(text)
        bar.rig_field.line.editingFinished.emit()
        assert bar.rig == rig
    assert bar.rig_field.line.text() == "virtual"


@pytest.mark.parametrize("length", [MAX_COLUMNS * 2, MAX_COLUMNS * 7 + 5])
def test_given_a_smooth_slope_then_thinning_makes_no_ripple_and_loses_no_peak(length: int) -> None:
    x = np.linspace(0.0, 1.0, length)
    for y in (x, -x, np.exp(-5 * x)):
        few_x, few_y = decimate(x, y)
        assert len(few_y) <= 2 * MAX_COLUMNS + 2 * length // MAX_COLUMNS
        assert (np.diff(few_x) >= 0).all()
        assert (np.diff(few_y) * np.sign(y[-1] - y[0]) >= 0).all()
        assert few_y.min() == y.min()
        assert few_y.max() == y.max()
    spike = np.zeros(length)
    spike[length // 3] = 1.0
    few_x, few_y = decimate(x, spike)
    assert few_x[few_y.argmax()] == x[length // 3]
