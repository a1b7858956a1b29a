"""The window's frame: errors, messages, files, size, theme, settings, accessibility, fast start."""

import threading

import numpy as np
import pytest
from PyQt5 import QtWidgets
from PyQt5.QtCore import Qt, QTimer
from PyQt5.QtGui import QColor, QFont

from tests.gui.conftest import campaign_of, pages_of, shown_tab, tab_of, wait
from tests.system.lines import python
from wavefocus.gui.field_map import Plot
from wavefocus.gui.scene.tab import SceneTab
from wavefocus.gui.theme import DARK, LIGHT, BoxStyle, palette_of
from wavefocus.gui.verification.tab import VerificationTab
from wavefocus.gui.window import Window
from wavefocus.storage.errors import InputError

OPEN_WINDOW = """
import sys
from PyQt5.QtCore import QSettings
from wavefocus.gui.files import Settings
from wavefocus.gui.window import Window, make_application
application = make_application()
window = Window(Settings(QSettings("memory.ini", QSettings.Format.IniFormat)))
window.show()
application.processEvents()
assert len(window.tabs) == 5
print(*sys.modules)
"""
NOT_LOADED = {
    "scipy", "h5py", "matplotlib", "soundfile", "wavefocus.mocks", "wavefocus.acquisition.engine.campaign",
    "wavefocus.rendering.field.prediction", "wavefocus.rendering.drive.rendering", "wavefocus.rendering.scene.model",
}  # fmt: skip


def test_errors_in_slots_and_threads_then_they_are_messages_and_the_window_lives(qtbot, shared_window, finished):
    window = shared_window
    window.open_file(finished)

    def slip():
        raise KeyError("a slip")

    def mistake():
        raise InputError("plate.h5: this and that is wrong")

    QTimer.singleShot(0, mistake)
    wait(qtbot, lambda: window.messages.sentence == "plate.h5: this and that is wrong")
    thread = threading.Thread(target=slip)
    for start in (thread.start, lambda: QTimer.singleShot(0, slip)):
        window.messages.dismiss()
        start()
        thread.join()
        assert window.messages.sentence == ""  # no widget is touched in the other thread
        wait(qtbot, lambda: "a slip" in window.messages.sentence)
        assert "in slip" in window.tracebacks.pop()
        assert [button.text() for button in window.messages.buttons] == ["Copy details"]
    wait(qtbot, lambda: campaign_of(window).campaign.measured == 12)


def test_given_messages_then_questions_wait_for_an_answer_and_no_control_moves(qtbot, shared_window):
    window = shared_window
    messages, button, answers = window.messages, campaign_of(window).run_field.browse, []
    place = button.mapTo(window, button.rect().center())
    for sentence in ("short", "a longer sentence that fills more than two lines " * 20):
        messages.fault(sentence, ("Answer", lambda: None))
        QtWidgets.QApplication.processEvents()
        assert button.mapTo(window, button.rect().center()) == place
        assert messages.sentence == sentence
    assert messages.label.text().endswith("…")
    assert messages.label.toolTip() == messages.sentence
    messages.ask("now or never?", ("Now", lambda: answers.append("now")))
    messages.fault("something else")
    assert messages.sentence == "now or never?"
    assert window.focusWidget() is messages.buttons[0]  # Space answers
    messages.buttons[0].click()
    assert answers == ["now"]
    assert messages.sentence == "something else"
    messages.dismiss()
    assert messages.sentence == ""


def test_large_text_and_a_long_message_then_the_window_still_fits_a_small_screen(qtbot, open_window, finished):
    font = QtWidgets.QApplication.font()
    large = QFont(font)
    large.setPointSize(font.pointSize() + 6)
    QtWidgets.QApplication.setFont(large)
    try:
        window = open_window(finished)
        window.messages.fault(f"/{'a_folder_without_spaces' * 40}/plate.h5: no such file")
        for tab in window.tabs:
            pages_of(window).setCurrentWidget(tab)
            QtWidgets.QApplication.processEvents()
            least = window.minimumSizeHint().expandedTo(window.minimumSize())
            assert least.width() <= 1280 - 16
            assert least.height() <= 800 - 48
        window.resize(1240, 720)
        assert (window.width(), window.height()) == (1240, 720)
    finally:
        QtWidgets.QApplication.setFont(font)


def test_given_a_screen_of_1280_by_800_then_no_page_scrolls(shared_window, finished):
    window = shared_window
    window.open_file(finished)
    heights = {tab.title: tab.minimumSizeHint().height() for tab in window.tabs}
    assert max(heights.values()) <= 800 - 150, heights  # menus, tabs, messages and the screen's own bars
    window.resize(1280, 800)
    scene = shown_tab(window, SceneTab)
    QtWidgets.QApplication.processEvents()
    assert scene.bar.name.width() >= scene.bar.name.fontMetrics().horizontalAdvance("scene.toml •")


def test_a_double_click_after_zooming_then_the_whole_of_a_clipped_plot_is_seen(qtbot):
    qtbot.addWidget(plot := Plot("a plot", "time (s)", "V"))
    plot.resize(400, 300)
    plot.show()
    plot.getPlotItem().setClipToView(True)
    plot.line(np.linspace(0.0, 1.0, 1000), np.zeros(1000), "#000000")
    plot.setXRange(0.4, 0.5, padding=0.0)
    QtWidgets.QApplication.processEvents()
    qtbot.mouseDClick(plot.viewport(), Qt.MouseButton.LeftButton, pos=plot.viewport().rect().center())
    low, high = plot.viewRange()[0]
    assert low <= 0.0
    assert high >= 1.0


def test_given_size_files_splitters_and_numbers_then_the_next_window_has_them_again(
    qtbot, open_window, finished, memory
):
    lab = finished.parent
    (lab / "scene.toml").write_text("[scene]\n", encoding="utf-8")
    window = open_window(lab / "run.toml")
    form = tab_of(window, VerificationTab).form
    form.take_bank(finished)
    form.out.show_path(lab / "empty")
    form.positions.setText("path")
    for splitter in splitters_of(window).values():
        pages_of(window).setCurrentWidget(next(tab for tab in window.tabs if tab.isAncestorOf(splitter)))
        sizes = splitter.sizes()
        splitter.setSizes([sizes[0] + 40, sizes[1] - 40, *sizes[2:]])
    tab_of(window, SceneTab).live_panel.look_ahead.setValue(120)
    moved = {name: (splitter.orientation(), splitter.saveState()) for name, splitter in splitters_of(window).items()}
    assert len(moved) >= 6
    window.resize(780, 560)
    window.close()
    memory.keep("scene/columns", QtWidgets.QSplitter(Qt.Orientation.Vertical).saveState())  # as another version had it
    again = Window(memory)
    assert (again.width(), again.height()) == (780, 560)
    assert campaign_of(again).bank_field.path is None
    again.restore_settings()
    tab, form = campaign_of(again), tab_of(again, VerificationTab).form
    assert (tab.run_field.path, tab.bank_field.path) == (lab / "run.toml", finished)
    files = [field.path for field in (form.scene, form.bank, form.rig, form.out)]
    assert files == [lab / "scene.toml", finished, lab / "rig.toml", lab / "empty"]
    assert form.positions.text() == "path"
    assert tab_of(again, SceneTab).live_panel.look_ahead.whole() == 120
    for name, splitter in splitters_of(again).items():
        assert splitter.orientation() == moved[name][0]
        assert splitter.saveState() == moved[name][1] or name == "columns"
    wait(qtbot, lambda: tab.campaign.measured == 12)
    again.close_at_once()


def splitters_of(window):
    return {
        name: one for tab in window.tabs for name, one in tab.remembered.items() if isinstance(one, QtWidgets.QSplitter)
    }


@pytest.mark.smoke
def test_given_an_empty_window_then_names_tooltips_keys_and_units_are_complete(open_window):
    window = open_window()
    with_tip = (QtWidgets.QAbstractButton, QtWidgets.QAbstractSpinBox, QtWidgets.QComboBox)
    kinds = (*with_tip, QtWidgets.QLineEdit, QtWidgets.QProgressBar, QtWidgets.QTableView)
    own = [
        control
        for kind in kinds
        for control in window.findChildren(kind)
        if not control.objectName().startswith("qt_") and type(control).__name__ != "QTableCornerButton"
        and not isinstance(control.parent(), (*kinds[1:4], QtWidgets.QTableView, QtWidgets.QTabBar))
    ]  # fmt: skip
    assert len(own) > 120
    assert [type(control).__name__ for control in own if not control.accessibleName()] == []
    assert [one.accessibleName() for one in own if isinstance(one, with_tip) and not one.toolTip()] == []
    keys = [one.shortcut().toString() for tab in window.tabs for one in tab.menu_actions() if one is not None]
    assert [key for key in keys if key and keys.count(key) != 1] == []
    scene, campaign = tab_of(window, SceneTab), campaign_of(window)
    for tab, plot in ((campaign, campaign.map_panel.map), (scene, scene.surface.canvas)):
        pages_of(window).setCurrentWidget(tab)
        plot.box.setRange(xRange=(-0.3, 0.3), yRange=(-0.3, 0.3))
        for side, word in (("left", "y (mm)"), ("bottom", "x (mm)")):
            axis = plot.getPlotItem().getAxis(side)
            assert axis.autoSIPrefixScale == 1.0
            assert word in axis.labelString()


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=lambda theme: theme.name)
def test_given_a_check_box_then_its_outline_and_its_tick_are_visible(qtbot, theme):
    option = QtWidgets.QStyleOptionButton()
    qtbot.addWidget(box := QtWidgets.QCheckBox("Snap"))
    box.setStyle(style := BoxStyle())
    box.setPalette(palette_of(theme))
    box.show()
    box.initStyleOption(option)
    whole = style.subElementRect(QtWidgets.QStyle.SubElement.SE_CheckBoxIndicator, option, box)
    inside = whole.adjusted(2, 2, -2, -2)

    def share(colour, part):
        image, wanted = box.grab(part).toImage(), QColor(colour).getRgb()
        colours = [image.pixelColor(x, y).getRgb() for x in range(image.width()) for y in range(image.height())]
        return float(np.mean(np.abs(np.subtract(colours, wanted)).max(axis=1) < 40))

    tick = QColor(theme.text).darker(120).name()  # as Fusion draws it
    assert share(theme.faint, whole) > 0.1
    assert share(tick, inside) == 0
    box.setChecked(True)
    assert share(tick, inside) > 0.04


def test_opening_a_window_loads_nothing_that_only_calculations_need(tmp_path):
    loaded = set(python("-c", OPEN_WINDOW, cwd=tmp_path).stdout.split())
    assert "wavefocus.gui.verification.tab" in loaded
    assert not loaded & NOT_LOADED
