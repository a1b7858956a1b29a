"""Errors of threads, a follower that fails, size, message bar, what is remembered, and lines without ripple."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PyQt5.QtCore import QThread, QTimer
from PyQt5.QtWidgets import QApplication
from pytestqt.qtbot import QtBot

from config.scene import SceneConfig, TextTable
from gui.campaign.plots import GreenPlot, Greens
from gui.process.command_process import CommandProcess
from gui.scene.draft import new_source
from gui.scene.results.exports import SceneCommands
from gui.scene.tab import SceneTab
from gui.shell.settings import Settings
from gui.shell.window import Window
from gui.surface.plot import MOST_COLUMNS, thinned
from storage.errors import InputError
from tests.gui.conftest import SOON_MS, campaign_of, wait, write_lab
from wavefocus.commands.gui import front_door


def test_given_an_error_in_a_thread_then_it_is_shown_by_the_windows_own_thread(
    qtbot: QtBot, open_window: Callable[..., Window], monkeypatch: pytest.MonkeyPatch
) -> None:
    window = open_window()
    shown_in = []
    show = window.messages._show

    def noting(*what: object) -> None:
        shown_in.append(QThread.currentThread())
        show(*what)

    monkeypatch.setattr(window.messages, "_show", noting)

    def slip() -> None:
        raise KeyError("a slip")

    thread = threading.Thread(target=slip)
    thread.start()
    thread.join()
    assert shown_in == []  # nothing is made in the other thread
    wait(qtbot, lambda: "a slip" in window.messages.sentence)
    assert shown_in == [QApplication.instance().thread()]
    assert "in slip" in window.mishaps.pop()


def test_given_a_defect_while_a_bank_is_followed_then_the_window_says_so_and_goes_on_following(
    qtbot: QtBot, open_window: Callable[..., Window], finished: Path
) -> None:
    window = open_window(finished)
    tab = campaign_of(window)
    wait(qtbot, lambda: tab.campaign.measured == 12)
    log = finished.with_name("plate.events.jsonl")
    kept = log.read_bytes()
    log.write_text('{"event": ["of no kind"]}\n' + "{}\n" * 1000, encoding="utf-8")
    wait(qtbot, lambda: "is not followed" in window.messages.sentence)
    assert [button.text() for button in window.messages.buttons()] == ["Copy details"]
    log.unlink()
    log.write_bytes(kept)
    wait(qtbot, lambda: tab.campaign.trouble.sentence == "")
    assert window.messages.sentence == ""
    assert tab.follower is not None
    assert tab.follower._thread.is_alive()


def test_given_large_text_and_a_long_message_then_the_window_still_fits_a_small_screen(
    qtbot: QtBot, open_window: Callable[..., Window], finished: Path
) -> None:
    window = open_window(finished)
    window._resize_text(6)
    try:
        window.messages.fault(f"/{'a_folder_without_spaces' * 40}/plate.h5: no such file")
        for tab in window.tabs:
            window._pages.setCurrentWidget(tab)
            qtbot.wait(50)
            least = window.minimumSizeHint().expandedTo(window.minimumSize())
            assert least.width() <= 1280 - 16
            assert least.height() <= 800 - 48
        window.resize(1240, 720)
        assert (window.width(), window.height()) == (1240, 720)
    finally:
        window._resize_text(-6)


def test_given_a_window_that_was_resized_then_the_next_one_is_as_large(
    qtbot: QtBot, open_window: Callable[..., Window], memory: Settings
) -> None:
    window = open_window()
    window.resize(780, 560)
    window.close()
    again = Window(front_door(), memory)
    assert (again.width(), again.height()) == (780, 560)
    again.close_at_once()


def test_given_a_message_then_no_control_is_moved_by_it(qtbot: QtBot, open_window: Callable[..., Window]) -> None:
    window = open_window()
    button = campaign_of(window).run_field.browse
    before = button.mapTo(window, button.rect().center())
    for sentence in ("short", "a longer sentence that fills more than two lines " * 20):
        window.messages.fault(sentence, ("Answer", lambda: None))
        qtbot.wait(20)
        assert button.mapTo(window, button.rect().center()) == before
        assert window.messages.sentence == sentence
    assert window.messages.label.text().endswith("…")
    assert window.messages.label.toolTip() == window.messages.sentence
    window.messages.dismiss()
    qtbot.wait(20)
    assert button.mapTo(window, button.rect().center()) == before


def test_given_another_run_file_then_the_bank_of_the_former_one_is_let_go(
    qtbot: QtBot, open_window: Callable[..., Window], finished: Path, tmp_path: Path
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


def test_given_a_run_and_a_bank_then_the_next_window_opens_them_again(
    qtbot: QtBot, open_window: Callable[..., Window], finished: Path
) -> None:
    window = open_window(finished.with_name("run.toml"))
    assert campaign_of(window).bank_field.path == finished
    window.close()
    again = open_window()
    assert campaign_of(again).bank_field.path is None
    again.restore_settings()
    tab = campaign_of(again)
    assert (tab.run_field.path, tab.bank_field.path) == (finished.with_name("run.toml"), finished)
    wait(qtbot, lambda: tab.campaign.measured == 12)


def test_given_no_bank_then_the_axes_of_the_map_are_in_millimetres(open_window: Callable[..., Window]) -> None:
    window = open_window()
    scene = next(tab for tab in window.tabs if isinstance(tab, SceneTab))
    campaign = campaign_of(window)
    for tab, plot in ((campaign, campaign.map_panel.map), (scene, scene.surface.canvas)):
        window._pages.setCurrentWidget(tab)
        plot.getPlotItem().getViewBox().setRange(xRange=(-0.3, 0.3), yRange=(-0.3, 0.3))
        for side, word in (("left", "y (mm)"), ("bottom", "x (mm)")):
            axis = plot.getPlotItem().getAxis(side)
            assert axis.autoSIPrefixScale == 1.0
            assert word in axis.labelString()


def test_given_virtual_typed_as_a_rig_then_it_stays_a_word(qtbot: QtBot, open_window: Callable[..., Window]) -> None:
    window = open_window()
    scene = next(tab for tab in window.tabs if isinstance(tab, SceneTab))
    window._pages.setCurrentWidget(scene)
    bar = scene.results.bar
    for text, rig in (("virtual", "virtual"), ("rig.toml", str(Path("rig.toml").absolute())), ("virtual", "virtual")):
        bar.rig_field.line.setText(text)
        bar.rig_field.line.editingFinished.emit()
        assert bar.rig == rig
    assert bar.rig_field.line.text() == "virtual"


@pytest.mark.parametrize("length", [MOST_COLUMNS * 2, MOST_COLUMNS * 7 + 5])
def test_given_a_smooth_slope_then_thinning_makes_no_ripple_and_loses_no_peak(length: int) -> None:
    x = np.linspace(0.0, 1.0, length)
    for y in (x, -x, np.exp(-5 * x)):
        few_x, few_y = thinned(x, y)
        assert len(few_y) <= 2 * MOST_COLUMNS + 2 * length // MOST_COLUMNS
        assert (np.diff(few_x) >= 0).all()
        assert (np.diff(few_y) * np.sign(y[-1] - y[0]) >= 0).all()
        assert few_y.min() == y.min()
        assert few_y.max() == y.max()
    spike = np.zeros(length)
    spike[length // 3] = 1.0
    few_x, few_y = thinned(x, spike)
    assert few_x[few_y.argmax()] == x[length // 3]


def test_given_a_disk_that_holds_the_follower_up_then_closing_does_not_wait_for_it(
    qtbot: QtBot, open_window: Callable[..., Window], finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    window = open_window(finished)
    tab = campaign_of(window)
    held, goes_on = threading.Event(), threading.Event()
    assert tab.follower is not None
    read = tab.follower._tail.read

    def hanging() -> object:
        held.set()
        goes_on.wait(60)
        return read()

    monkeypatch.setattr(tab.follower._tail, "read", hanging)
    wait(qtbot, held.is_set)
    answered = []
    QTimer.singleShot(0, lambda: answered.append(window.close()))
    wait(qtbot, lambda: answered == [True])
    assert tab.follower._thread.is_alive()  # it is left behind, not waited for
    goes_on.set()


def test_given_a_weak_actuator_then_its_trace_can_be_drawn_to_its_own_peak(qtbot: QtBot) -> None:
    surface = SimpleNamespace(sample_rate_hz=1000.0, unit="m/s/V")
    green = np.outer([1.0, 1e-6], np.sin(np.arange(100.0)))
    plot = GreenPlot()
    qtbot.addWidget(plot)

    def spans() -> list[float]:
        return [float(np.ptp(curve.getData()[1])) for curve in plot.getPlotItem().listDataItems()]

    plot.show_green(surface, Greens(0, green), -1, waterfall=False)
    assert spans()[1] < 1e-5
    plot.show_green(surface, Greens(0, green), -1, waterfall=False, own_scale=True)
    assert spans()[1] == pytest.approx(spans()[0])
    assert all(curve.opts["antialias"] for curve in plot.getPlotItem().listDataItems())


def test_given_a_large_scene_then_a_box_allows_it_in_the_window_and_in_its_commands(
    qtbot: QtBot, open_window: Callable[..., Window]
) -> None:
    window = open_window()
    tab = next(one for one in window.tabs if isinstance(one, SceneTab))
    document = tab.document
    text = TextTable(string="wave" * 300, height_mm=8.0)
    document.edit("add", SceneConfig(source=(new_source(text),)))
    with pytest.raises(InputError, match="1200 letters"):
        document.scene()
    tab.scene_form.large.setChecked(True)
    assert document.scene().allow_large
    job = SceneCommands(window.context, document, "")
    assert "--allow-large" in job.render()
    job.close()
    wait(qtbot, lambda: bool(tab.live.idle and tab.live.preview.traces and not tab.live.preview.traces[0].problem))


@pytest.mark.parametrize("folder", ["lab", "missing"])
def test_given_a_link_where_a_run_keeps_its_words_then_what_it_points_to_stays(
    qtbot: QtBot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    precious = tmp_path / "precious"
    precious.write_text("precious", encoding="utf-8")
    (tmp_path / "lab").mkdir()
    said = tmp_path / folder / "plate.h5.said"
    for link in (tmp_path / "lab" / said.name, tmp_path / said.name):
        link.symlink_to(precious)
    run = CommandProcess(front_door(), ["status", "nothing.h5"], QApplication.instance(), log_file=said)
    with qtbot.waitSignal(run.finished, timeout=SOON_MS):
        pass
    assert "nothing.h5" in run.last_line
    assert run.exit_code == 2
    assert precious.read_text(encoding="utf-8") == "precious"
