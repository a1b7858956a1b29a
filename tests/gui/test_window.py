"""The window's frame: errors, messages, files, size, theme, settings, accessibility, fast start."""

import ast
import importlib
import threading
from pathlib import Path

import numpy as np
import pytest
from PyQt5.QtCore import QRect, Qt, QTimer
from PyQt5.QtGui import QColor, QFont
from PyQt5.QtWidgets import (
    QAbstractButton,
    QAbstractSpinBox,
    QApplication,
    QCheckBox,
    QComboBox,
    QLineEdit,
    QProgressBar,
    QSplitter,
    QStyle,
    QStyleOptionButton,
    QTabBar,
    QTableView,
)

import wavefocus.gui
from tests.gui.conftest import campaign_of, shown_tab, tab_of, wait, write_lab
from tests.system.test_process_of_a_command import loaded_by
from wavefocus.gui.field_map import Plot
from wavefocus.gui.scene.tab import SceneTab
from wavefocus.gui.theme import DARK, LIGHT, BoxStyle, palette_of
from wavefocus.gui.window import Window
from wavefocus.storage.errors import InputError

OPEN_WINDOW = """
import os
os.environ["QT_QPA_PLATFORM"] = "offscreen"
from pathlib import Path
from PyQt5.QtCore import QSettings
from wavefocus.gui.window import make_application
from wavefocus.gui.files import Settings
from wavefocus.gui.window import Window
application = make_application()
window = Window(Settings(QSettings(str(Path("memory.ini").absolute()), QSettings.Format.IniFormat)))
window.show()
application.processEvents()
assert len(window.tabs) == 5
"""


def test_errors_in_slots_and_threads_then_they_are_messages_and_the_window_lives(qtbot, shared_window, finished):
    window = shared_window
    window.open_file(finished)

    def slip() -> None:
        raise KeyError("a slip")

    def mistake() -> None:
        raise InputError("plate.h5: this and that is wrong")

    QTimer.singleShot(0, slip)
    wait(qtbot, lambda: "a slip" in window.messages.sentence)
    assert "in slip" in window.tracebacks.pop()
    assert [button.text() for button in window.messages.buttons] == ["Copy details"]
    QTimer.singleShot(0, mistake)
    wait(qtbot, lambda: window.messages.sentence == "plate.h5: this and that is wrong")
    window.messages.dismiss()
    thread = threading.Thread(target=slip)
    thread.start()
    thread.join()
    assert window.messages.sentence == ""  # no widget is touched in the other thread
    wait(qtbot, lambda: "a slip" in window.messages.sentence)
    assert "in slip" in window.tracebacks.pop()
    wait(qtbot, lambda: campaign_of(window).campaign.measured == 12)


def test_given_messages_then_questions_wait_for_an_answer_and_no_control_moves(qtbot, shared_window):
    window = shared_window
    messages, button, answers = window.messages, campaign_of(window).run_field.browse, []
    place = button.mapTo(window, button.rect().center())
    for sentence in ("short", "a longer sentence that fills more than two lines " * 20):
        messages.fault(sentence, ("Answer", lambda: None))
        QApplication.processEvents()
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


def test_given_files_then_a_tab_opens_each_and_they_are_remembered(open_window, finished, memory, tmp_path):
    window = open_window()
    rig, run = tmp_path / "rig.toml", write_lab(tmp_path / "other", 2, 2)
    rig.write_text("[rig]\n", encoding="utf-8")
    (tmp_path / "scene.toml").write_text("[scene]\n", encoding="utf-8")
    for path in (rig, tmp_path / "scene.toml", finished, run):
        window.open_file(path)
    tab = campaign_of(window)
    assert (tab.run_field.path, tab.bank_field.path) == (run, finished)
    assert memory.recent()[:2] == [run, finished]
    window.open_file(run.with_name("positions.txt"))
    assert "no tab opens such a file" in window.messages.sentence


def test_large_text_and_a_long_message_then_the_window_still_fits_a_small_screen(qtbot, open_window, finished):
    font = QApplication.font()
    large = QFont(font)
    large.setPointSize(font.pointSize() + 6)
    QApplication.setFont(large)
    try:
        window = open_window(finished)
        window.messages.fault(f"/{'a_folder_without_spaces' * 40}/plate.h5: no such file")
        for tab in window.tabs:
            window._pages.setCurrentWidget(tab)
            QApplication.processEvents()
            least = window.minimumSizeHint().expandedTo(window.minimumSize())
            assert least.width() <= 1280 - 16
            assert least.height() <= 800 - 48
        window.resize(1240, 720)
        assert (window.width(), window.height()) == (1240, 720)
    finally:
        QApplication.setFont(font)


def test_given_a_screen_of_1280_by_800_then_no_page_scrolls(shared_window, finished):
    window = shared_window
    window.open_file(finished)
    heights = {tab.title: tab.minimumSizeHint().height() for tab in window.tabs}
    assert max(heights.values()) <= 800 - 150, heights  # menus, tabs, messages and the screen's own bars
    window.resize(1280, 800)
    scene = shown_tab(window, SceneTab)
    QApplication.processEvents()
    assert scene.bar.name.width() >= scene.bar.name.fontMetrics().horizontalAdvance("scene.toml •")


def test_a_double_click_after_zooming_then_the_whole_of_a_clipped_plot_is_seen(qtbot):
    plot = Plot("a plot", "time (s)", "V")
    qtbot.addWidget(plot)
    plot.resize(400, 300)
    plot.show()
    plot.getPlotItem().setClipToView(True)
    plot.line(np.linspace(0.0, 1.0, 1000), np.zeros(1000), "#000000")
    plot.setXRange(0.4, 0.5, padding=0.0)
    QApplication.processEvents()
    qtbot.mouseDClick(plot.viewport(), Qt.MouseButton.LeftButton, pos=plot.viewport().rect().center())
    low, high = plot.viewRange()[0]
    assert low <= 0.0
    assert high >= 1.0


def test_given_size_run_and_bank_then_the_next_window_has_them_again(qtbot, open_window, finished, memory):
    window = open_window(finished.with_name("run.toml"))
    assert campaign_of(window).bank_field.path == finished
    window.resize(780, 560)
    window.close()
    again = Window(memory)
    assert (again.width(), again.height()) == (780, 560)
    assert campaign_of(again).bank_field.path is None
    again.restore_settings()
    tab = campaign_of(again)
    assert (tab.run_field.path, tab.bank_field.path) == (finished.with_name("run.toml"), finished)
    wait(qtbot, lambda: tab.campaign.measured == 12)
    again.close_at_once()


def test_splitters_and_numbers_then_next_window_has_them_and_each_its_own_direction(open_window, memory):
    window = open_window()
    splitters = {name: one for tab in window.tabs for name, one in tab.remembered.items() if isinstance(one, QSplitter)}
    assert len(splitters) >= 6
    for splitter in splitters.values():
        window._pages.setCurrentWidget(next(tab for tab in window.tabs if tab.isAncestorOf(splitter)))
        sizes = splitter.sizes()
        splitter.setSizes([sizes[0] + 40, sizes[1] - 40, *sizes[2:]])
    tab_of(window, SceneTab).live_panel.look_ahead.setValue(120)
    moved = {name: (splitter.orientation(), splitter.saveState()) for name, splitter in splitters.items()}
    window.close()
    turned = QSplitter(Qt.Orientation.Vertical)
    memory.keep("scene/columns", turned.saveState())
    again = open_window()
    assert tab_of(again, SceneTab).live_panel.look_ahead.whole() == 120
    for tab in again.tabs:
        for name, one in tab.remembered.items():
            if isinstance(one, QSplitter):
                assert one.orientation() == moved[name][0]
                assert one.saveState() == moved[name][1] or name == "columns"


@pytest.mark.smoke
def test_given_an_empty_window_then_names_tooltips_keys_and_units_are_complete(open_window):
    window = open_window()
    with_tip = (QAbstractButton, QAbstractSpinBox, QComboBox)
    kinds = (*with_tip, QLineEdit, QProgressBar, QTableView)
    own = [
        control
        for kind in kinds
        for control in window.findChildren(kind)
        if not control.objectName().startswith("qt_") and type(control).__name__ != "QTableCornerButton"
        and not isinstance(control.parent(), QTableView | QComboBox | QAbstractSpinBox | QLineEdit | QTabBar)
    ]  # fmt: skip
    assert len(own) > 120
    assert [type(control).__name__ for control in own if not control.accessibleName()] == []
    assert [one.accessibleName() for one in own if isinstance(one, with_tip) and not one.toolTip()] == []
    actions = [action for tab in window.tabs[:2] for action in tab.menu_actions() if action is not None]
    everything = [one for tab in window.tabs for one in tab.menu_actions() if one is not None]
    keys = [action.shortcut().toString() for action in everything]
    own_keys = [action.shortcut().toString() for action in actions]
    assert [key for key in own_keys if key and keys.count(key) != 1] == []
    scene, campaign = tab_of(window, SceneTab), campaign_of(window)
    for tab, plot in ((campaign, campaign.map_panel.map), (scene, scene.surface.canvas)):
        window._pages.setCurrentWidget(tab)
        plot.getPlotItem().getViewBox().setRange(xRange=(-0.3, 0.3), yRange=(-0.3, 0.3))
        for side, word in (("left", "y (mm)"), ("bottom", "x (mm)")):
            axis = plot.getPlotItem().getAxis(side)
            assert axis.autoSIPrefixScale == 1.0
            assert word in axis.labelString()


@pytest.mark.parametrize("theme", [LIGHT, DARK], ids=lambda theme: theme.name)
def test_given_a_check_box_then_its_outline_and_its_tick_are_visible(qtbot, theme):
    style, option = BoxStyle(), QStyleOptionButton()
    box = QCheckBox("Snap")
    qtbot.addWidget(box)
    box.setStyle(style)
    box.setPalette(palette_of(theme))
    box.show()
    box.initStyleOption(option)
    whole = style.subElementRect(QStyle.SubElement.SE_CheckBoxIndicator, option, box)
    inside = whole.adjusted(2, 2, -2, -2)

    def share(colour: str, part: QRect) -> float:
        image, wanted = box.grab(part).toImage(), QColor(colour).getRgb()
        colours = [image.pixelColor(x, y).getRgb() for x in range(image.width()) for y in range(image.height())]
        return float(np.mean(np.abs(np.subtract(colours, wanted)).max(axis=1) < 40))

    tick = QColor(theme.text).darker(120).name()  # as Fusion draws it
    assert share(theme.faint, whole) > 0.1
    assert share(tick, inside) == 0
    box.setChecked(True)
    assert share(tick, inside) > 0.04


@pytest.mark.smoke
def test_opening_a_window_loads_nothing_that_only_calculations_need(tmp_path):
    loaded = loaded_by(OPEN_WINDOW, tmp_path)
    assert "wavefocus.gui.verification.tab" in loaded
    assert not loaded & {
        "scipy",
        "h5py",
        "matplotlib",
        "soundfile",
        "wavefocus.mocks",
        "wavefocus.acquisition.engine.campaign",
    }
    assert not loaded & {
        "wavefocus.rendering.field.prediction",
        "wavefocus.rendering.drive.rendering",
        "wavefocus.rendering.scene.model",
    }


def own_names(node: ast.AST, context: type[ast.expr_context]) -> set[str]:
    """Names that are read (Load) or set (Store) of `self`."""
    found = [one for one in ast.walk(node) if isinstance(one, ast.Attribute) and isinstance(one.ctx, context)]
    return {one.attr for one in found if isinstance(one.value, ast.Name) and one.value.id == "self"}


def test_given_all_classes_of_the_window_then_what_they_read_of_themselves_exists():
    """PyQt5's types give QObject a `__getattr__`, so that the type checker lets any name pass."""
    folder, nodes = Path(wavefocus.gui.__file__).resolve().parent, {}
    for path in folder.rglob("*.py"):
        parts = path.relative_to(folder).with_suffix("").parts
        module = importlib.import_module(".".join(["wavefocus.gui", *parts]).removesuffix(".__init__"))
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                nodes[getattr(module, node.name)] = node
    assert len(nodes) > 60
    missing = {}
    for kind, node in nodes.items():
        held = set(dir(kind)).union(*(getattr(base, "__annotations__", ()) for base in kind.__mro__))
        held = held.union(*(own_names(nodes[base], ast.Store) for base in kind.__mro__ if base in nodes))
        missing[kind] = own_names(node, ast.Load) - held
    assert {kind: names for kind, names in missing.items() if names} == {}
