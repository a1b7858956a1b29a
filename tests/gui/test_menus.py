"""Every action of every menu, triggered in every tab, and what File > Open opens."""

from pathlib import Path

import pytest
from PyQt5 import QtWidgets
from PyQt5.QtCore import QObject, Qt, QUrl, pyqtSlot
from PyQt5.QtGui import QDesktopServices
from PyQt5.QtTest import QTest

from tests.gui.conftest import campaign_of, line_scene, menus, pages_of, tab_of, wait
from wavefocus.gui.rig.tab import RigTab
from wavefocus.gui.scene.document import scene_toml
from wavefocus.gui.scene.tab import SceneTab
from wavefocus.gui.surface_view import SurfaceView

# What can be done in an empty window; Play and Stop, for one, cannot.
ALWAYS = (
    "New &lab…", "&Open…", "Accept another &calibration", "&Run file", "&Rig file", "&New", "&Save", "Save &as…",
    "Verify", "Cancel",
)  # fmt: skip


def actions(menu):
    return [action for action in menu.actions() if not action.isSeparator() and action.menu() is None]


def close_dialogs(window):
    dialogs = [dialog for dialog in window.findChildren(QtWidgets.QFileDialog) if dialog.isVisible()]
    for dialog in dialogs:
        dialog.reject()
    return len(dialogs)


@pytest.fixture
def lab(finished):
    """Its run, rig and scene file, and its bank."""
    (scene := finished.with_name("scene.toml")).write_text(scene_toml(line_scene()), encoding="utf-8")
    return [finished.with_name("run.toml"), finished.with_name("rig.toml"), scene, finished]


@pytest.mark.parametrize(("tab", "with_files"), [(0, False), (3, True)], ids=["empty", "with files"])
def test_given_every_action_of_every_menu_then_no_error_is_raised(qtbot, open_window, lab, tab, with_files):
    window = open_window(*(lab if with_files else ()))
    campaign, rig = campaign_of(window), tab_of(window, RigTab)
    wait(qtbot, lambda: campaign.campaign.measured == 12 or not with_files)
    enabled = []
    for menu in menus(window).values():
        menu.aboutToShow.emit()
        for action in actions(menu):
            if action.text() in ("&Quit", "&Documentation"):
                continue
            pages_of(window).setCurrentIndex(tab)
            window.refresh()
            action.trigger()
            QtWidgets.QApplication.processEvents()
            enabled += [action.text()] if action.isEnabled() else []
            close_dialogs(window)
            assert window.tracebacks == [], action.text()
    assert set(ALWAYS) <= set(enabled)
    assert len(enabled) > 10 if with_files else enabled == list(ALWAYS)
    window.refresh()
    rig.examination.cancel.trigger()
    rig.session.release()
    wait(qtbot, lambda: not (rig.session.running or rig.examination.command.running))


def each_page(window):
    """Show each page of each tab, one after the other."""
    for tab in window.tabs:
        pages_of(window).setCurrentWidget(tab)
        book = tab.findChild(QtWidgets.QTabWidget)
        for page in range(1 if book is None else book.count()):
            if book is not None:
                book.setCurrentIndex(page)
            yield tab, page


def test_given_alt_and_a_letter_then_it_leads_to_one_place_on_each_page(shared_window):
    for tab, page in each_page(shared_window):
        QtWidgets.QApplication.processEvents()
        parts = [one for one in tab.findChildren((QtWidgets.QAbstractButton, QtWidgets.QLabel)) if one.isVisible()]
        texts = [one.text() for one in (*shared_window.menuBar().actions(), *parts)]
        letters = [text[text.index("&") + 1].lower() for text in texts if "&" in text[:-1] and "&nbsp" not in text]
        assert sorted(letters) == sorted(set(letters)), f"page {page} of {tab.title}"


def test_given_help_then_the_documentation_beside_the_program_is_opened(shared_window):
    opened = []

    class Desktop(QObject):
        @pyqtSlot(QUrl)
        def open(self, url):
            opened.append(url.toLocalFile())

    desktop = Desktop()  # Qt holds no reference
    QDesktopServices.setUrlHandler("file", desktop.open)
    try:
        (documentation,) = actions(menus(shared_window)["Help"])
        assert documentation.shortcut().toString() == "F1"
        documentation.trigger()
    finally:
        QDesktopServices.unsetUrlHandler("file")
    (page,) = map(Path, opened)
    assert page.is_file()
    assert page.name in ("index.html", "README.md")


def test_given_ctrl_o_in_any_tab_then_what_is_chosen_is_opened_and_remembered(qtbot, open_window, lab, memory):
    run, rig, scene, bank = lab
    window = open_window()
    for tab in range(4):
        close_dialogs(window)
        with qtbot.waitActive(window):
            window.activateWindow()
        pages_of(window).setCurrentIndex(tab)
        QTest.keyClick(window, Qt.Key.Key_O, Qt.KeyboardModifier.ControlModifier)
        (dialog,) = (dialog for dialog in window.findChildren(QtWidgets.QFileDialog) if dialog.isVisible())
    dialog.filesSelected.emit([str(file) for file in lab])
    close_dialogs(window)
    campaign = campaign_of(window)
    assert (campaign.run_field.path, campaign.bank_field.path) == (run, bank)
    assert (tab_of(window, RigTab).rig_field.path, tab_of(window, SceneTab).document.path) == (rig, scene)
    assert pages_of(window).currentWidget() is campaign  # that of the last one
    assert memory.recent()[:4] == lab[::-1]
    window.open_file(bank.with_name("positions.txt"))
    assert "no tab opens such a file" in window.messages.sentence


KINDS = (
    QtWidgets.QAbstractButton, QtWidgets.QComboBox, QtWidgets.QAbstractItemView, QtWidgets.QPlainTextEdit,
    QtWidgets.QAbstractSpinBox, SurfaceView,
)  # fmt: skip


@pytest.mark.timeout(500)
def test_given_the_tab_key_alone_then_it_reaches_every_control_of_each_tab(qtbot, open_window, lab):
    window = open_window(*lab[:2], lab[3])
    wait(qtbot, lambda: campaign_of(window).campaign.measured == 12)
    for tab, page in each_page(window):
        assert not_reached(qtbot, window, tab) == [], f"page {page} of {tab.title}"


def not_reached(qtbot, window, tab):
    """Press Tab until the focus is where it was; the controls that never had it."""
    with qtbot.waitActive(window):
        window.activateWindow()
    window.refresh()
    QtWidgets.QApplication.processEvents()
    reached = []
    while (here := QtWidgets.QApplication.focusWidget()) not in reached:
        reached.append(here)
        QTest.keyClick(here or window, Qt.Key.Key_Tab)
    wanted = [
        one
        for one in tab.findChildren(KINDS)
        if one.isVisible() and one.isEnabled() and one.focusPolicy() & Qt.FocusPolicy.TabFocus
        and not (isinstance(one, QtWidgets.QAbstractButton) and one.autoExclusive() and not one.isChecked())
    ]  # fmt: skip
    assert wanted
    return [one.accessibleName() for one in wanted if one not in reached]
