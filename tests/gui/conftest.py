"""Windows that are real but for the screen, and campaigns on the virtual rig in processes of their own."""

import itertools
import os
import shutil
from contextlib import ExitStack, contextmanager

import pytest

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
# One pixel is one unit, whatever the platform thinks of its screen.
os.environ.setdefault("QT_FONT_DPI", "96")

from PyQt5.QtCore import QEvent, QPointF, QSettings, Qt
from PyQt5.QtGui import QMouseEvent
from PyQt5.QtWidgets import QAction, QApplication, QTabWidget, QToolButton
from pytestqt.exceptions import TimeoutError

from tests.lab_files import RIG, RUN, change_text, write_positions
from wavefocus.__main__ import run
from wavefocus.config.scene import LineTable, Output, SceneConfig, SceneTable, SineTable, SourceTable
from wavefocus.gui.campaign.tab import CampaignTab
from wavefocus.gui.files import Settings
from wavefocus.gui.scene.document import SOURCE, build_draft, scene_toml
from wavefocus.gui.window import Window, require_fonts

LEFT, NO_KEY = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier
# What a busy machine may take; nothing is judged by it.
SOON_MS = 90_000


def write_lab(folder, columns, rows):
    """Write the files of a campaign on a grid of 1.5 mm; return the run file."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    (folder / "run.toml").write_text(RUN, encoding="utf-8")
    write_positions(folder, [(1.5 * column, 1.5 * row) for row in range(rows) for column in range(columns)])
    return folder / "run.toml"


@pytest.fixture(scope="session")
def measured(tmp_path_factory):
    """A folder with a finished campaign of 4 x 3 positions whose recordings were kept; to be copied."""
    run_file = write_lab(tmp_path_factory.mktemp("measured"), 4, 3)
    change_text(run_file, "[capture]", "[capture]\nkeep_raw = true")
    assert run(["capture", str(run_file), "--bank", str(run_file.with_name("plate.h5"))]) == 0
    return run_file.parent


@pytest.fixture
def finished(measured, tmp_path):
    """The bank of a finished campaign, with all that lies beside it."""
    return shutil.copytree(measured, tmp_path / "lab") / "plate.h5"


@pytest.fixture
def memory(tmp_path):
    """What the windows of a test remember."""
    return Settings(QSettings(str(tmp_path / "memory.ini"), QSettings.Format.IniFormat))


@pytest.fixture
def open_window(qtbot, memory):
    """Opens windows, and fails when anything went wrong in them that the test did not ask for."""
    with ExitStack() as opened:

        def make(*files):
            window = opened.enter_context(kept_window(memory))
            for path in files:
                window.open_file(path)
            return window

        yield make


@pytest.fixture(scope="module")
def shared_window(qapp, tmp_path_factory):
    """One window for the tests of a module that neither close nor crash it."""
    folder = tmp_path_factory.mktemp("window")
    memory = Settings(QSettings(str(folder / "memory.ini"), QSettings.Format.IniFormat))
    memory.keep("folder/.toml", str(folder))
    with kept_window(memory) as window:
        yield window


@contextmanager
def kept_window(memory):
    """A window that leaves nothing running, and has no error that a test did not ask for."""
    require_fonts()
    window = Window(memory)
    window.resize(1280, 800)  # whatever the platform thinks of its screen
    window.show()
    try:
        yield window
    finally:
        campaign_of(window).run.interrupt()
        window.close_at_once()
        assert window.tracebacks == []
        window.deleteLater()


def tab_of(window, kind):
    (tab,) = (one for one in window.tabs if isinstance(one, kind))
    return tab


def shown_tab(window, kind):
    """The tab of a kind, brought to the front."""
    pages_of(window).setCurrentWidget(tab := tab_of(window, kind))
    return tab


def pages_of(window):
    return next(one for one in window.findChildren(QTabWidget) if one.count() == len(window.tabs))


def campaign_of(window):
    return tab_of(window, CampaignTab)


def wait(qtbot, true, within_ms=SOON_MS):
    """Let the window live until something is so; else say what it showed."""
    try:
        qtbot.waitUntil(lambda: bool(true()), timeout=within_ms)
    except TimeoutError:
        windows = [widget for widget in QApplication.topLevelWidgets() if isinstance(widget, Window)]
        shown = [(campaign_of(window).progress.state.text(), window.messages.sentence) for window in windows]
        pytest.fail(f"it did not come about; the windows show {shown}")


def press(qtbot, button):
    """Click a button, or that of an action, as soon as it can be clicked."""
    if isinstance(button, QAction):
        button = next(one for one in button.associatedWidgets() if isinstance(one, QToolButton))
    wait(qtbot, lambda: button.isVisible() and button.isEnabled())
    qtbot.mouseClick(button, LEFT)


def menus(window):
    """The menus of a window, by their titles."""
    found = ((action.text().replace("&", ""), action.menu()) for action in window.menuBar().actions())
    return {title: menu for title, menu in found if menu is not None}


def answer(window, word):
    next(button for button in window.messages.buttons if button.text() == word).click()


def edit(document, draft, chosen=None):
    """Type the text of a scene, and perhaps go to one of its sources."""
    document.replace(scene_toml(draft))
    if chosen is not None:
        document.choose((SOURCE, chosen))


def scene_of(document):
    """The scene that commands make of the text."""
    return build_draft(document.draft, document.place)


def pixel(shown, x_mm, y_mm):
    return shown.mapFromScene(shown.box.mapViewToScene(QPointF(x_mm, y_mm)))


def mouse(shown, kind, at, keys, *, held):
    button = Qt.MouseButton.NoButton if kind == QEvent.Type.MouseMove else LEFT
    buttons = LEFT if held else Qt.MouseButton.NoButton
    viewport = shown.viewport()
    place = QPointF(viewport.mapToGlobal(at))
    QApplication.sendEvent(viewport, QMouseEvent(kind, QPointF(at), place, button, Qt.MouseButtons(buttons), keys))


def click(shown, at, keys=NO_KEY):
    mouse(shown, QEvent.Type.MouseMove, at, keys, held=False)
    mouse(shown, QEvent.Type.MouseButtonPress, at, keys, held=True)
    mouse(shown, QEvent.Type.MouseButtonRelease, at, keys, held=False)


def drag(qtbot, shown, points, keys):
    mouse(shown, QEvent.Type.MouseMove, points[0], keys, held=False)
    mouse(shown, QEvent.Type.MouseButtonPress, points[0], keys, held=True)
    for one, other in itertools.pairwise(points):
        for part in range(1, 5):
            qtbot.wait(15)  # the map looks at the mouse a hundred times a second
            mouse(shown, QEvent.Type.MouseMove, one + (other - one) * part / 4, keys, held=True)
    mouse(shown, QEvent.Type.MouseButtonRelease, points[-1], keys, held=False)


def line_scene(end_mm=4.5, amplitude=1.0, **output):
    """A sine of 150 Hz that moves along the first row of the measured bank."""
    source = SourceTable(
        path=LineTable(start_mm=(0.0, 0.0), end_mm=(end_mm, 0.0)),
        signal=SineTable(frequency_hz=150.0, duration_s=0.2),
        speed_mm_s=30.0, step_mm=1.5, amplitude=amplitude, emission="continuous",
    )  # fmt: skip
    limits = Output(**{"interpolation": "nearest", **output})
    return SceneConfig(scene=SceneTable(name="line"), source=(source,), output=limits)
