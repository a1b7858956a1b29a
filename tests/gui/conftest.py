"""Windows that are real but for the screen, and campaigns on the virtual rig in processes of their own."""

import itertools
import os
import shutil
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, TypeVar

import pytest

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
# One pixel is one unit, whatever the platform thinks of its screen.
os.environ.setdefault("QT_FONT_DPI", "96")

from PyQt5.QtCore import QEvent, QPoint, QPointF, QSettings, Qt
from PyQt5.QtGui import QMouseEvent
from PyQt5.QtWidgets import QAction, QApplication, QMenu, QTabWidget, QToolButton, QWidget
from pytestqt.exceptions import TimeoutError
from pytestqt.qtbot import QtBot

from tests.lab_files import RIG, RUN, change_text, write_positions
from wavefocus.__main__ import run
from wavefocus.config.scene import LineTable, Output, SceneConfig, SceneTable, SineTable, SourceTable
from wavefocus.gui.campaign.tab import CampaignTab
from wavefocus.gui.files import Settings
from wavefocus.gui.scene.document import SOURCE, SceneDocument, build_draft, scene_toml
from wavefocus.gui.surface_view import SurfaceView
from wavefocus.gui.tab import Tab
from wavefocus.gui.window import Window, require_fonts
from wavefocus.rendering.scene.model import Scene

AnyTab = TypeVar("AnyTab", bound=Tab)
LEFT, NO_KEY = Qt.MouseButton.LeftButton, Qt.KeyboardModifier.NoModifier
# What a busy machine may take; nothing is judged by it.
SOON_MS = 90_000


def write_lab(folder: Path, columns: int, rows: int) -> Path:
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
def long_run(tmp_path):
    """The run file of a campaign that takes longer than any order on a busy machine; no test waits for its end."""
    return write_lab(tmp_path / "lab", 50, 40)


@pytest.fixture
def memory(tmp_path):
    """What the windows of a test remember."""
    return Settings(QSettings(str(tmp_path / "memory.ini"), QSettings.Format.IniFormat))


@pytest.fixture
def open_window(qtbot, memory):
    """Opens windows, and fails when anything went wrong in them that the test did not ask for."""
    with ExitStack() as opened:

        def make(*files: Path) -> Window:
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
def kept_window(memory: Settings) -> Generator[Window]:
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


def tab_of(window: Window, kind: type[AnyTab]) -> AnyTab:
    """The tab of a kind in a window."""
    (tab,) = (one for one in window.tabs if isinstance(one, kind))
    return tab


def shown_tab(window: Window, kind: type[AnyTab]) -> AnyTab:
    """The tab of a kind, brought to the front."""
    pages_of(window).setCurrentWidget(tab := tab_of(window, kind))
    return tab


def pages_of(window: Window) -> QTabWidget:
    """The tabs of a window."""
    return next(one for one in window.findChildren(QTabWidget) if one.count() == len(window.tabs))


def campaign_of(window: Window) -> CampaignTab:
    return tab_of(window, CampaignTab)


def wait(qtbot: QtBot, true: Callable[[], object], within_ms: int = SOON_MS) -> None:
    """Let the window live until something is so; else say what it showed."""
    try:
        qtbot.waitUntil(lambda: bool(true()), timeout=within_ms)
    except TimeoutError:
        windows = [widget for widget in QApplication.topLevelWidgets() if isinstance(widget, Window)]
        shown = [(campaign_of(window).progress.state.text(), window.messages.sentence) for window in windows]
        pytest.fail(f"it did not come about; the windows show {shown}")


def press(qtbot: QtBot, button: QWidget | QAction) -> None:
    """Click a button, or that of an action, as soon as it can be clicked."""
    if isinstance(button, QAction):
        button = next(one for one in button.associatedWidgets() if isinstance(one, QToolButton))
    wait(qtbot, lambda: button.isVisible() and button.isEnabled())
    qtbot.mouseClick(button, LEFT)


def menus(window: Window) -> dict[str, QMenu]:
    """The menus of a window, by their titles."""
    bar = window.menuBar()
    assert bar is not None
    return {action.text().replace("&", ""): menu for action in bar.actions() if (menu := action.menu()) is not None}


def answer(window: Window, word: str) -> None:
    """Press a button of the message bar."""
    next(button for button in window.messages.buttons if button.text() == word).click()


def edit(document: SceneDocument, draft: SceneConfig, chosen: int | None = None) -> None:
    """Type the text of a scene, and perhaps go to one of its sources."""
    document.replace(scene_toml(draft))
    if chosen is not None:
        document.choose((SOURCE, chosen))


def scene_of(document: SceneDocument) -> Scene:
    """The scene that commands make of the text."""
    return build_draft(document.draft, document.place)


def pixel(shown: SurfaceView, x_mm: float, y_mm: float) -> QPoint:
    return shown.mapFromScene(shown.box.mapViewToScene(QPointF(x_mm, y_mm)))


def mouse(shown: SurfaceView, kind: QEvent.Type, at: QPoint, keys: Qt.KeyboardModifier, *, held: bool) -> None:
    button = Qt.MouseButton.NoButton if kind == QEvent.Type.MouseMove else LEFT
    buttons = LEFT if held else Qt.MouseButton.NoButton
    viewport = shown.viewport()
    place = QPointF(viewport.mapToGlobal(at))
    QApplication.sendEvent(viewport, QMouseEvent(kind, QPointF(at), place, button, Qt.MouseButtons(buttons), keys))


def click(shown: SurfaceView, at: QPoint, keys: Qt.KeyboardModifier = NO_KEY) -> None:
    mouse(shown, QEvent.Type.MouseMove, at, keys, held=False)
    mouse(shown, QEvent.Type.MouseButtonPress, at, keys, held=True)
    mouse(shown, QEvent.Type.MouseButtonRelease, at, keys, held=False)


def drag(qtbot: QtBot, shown: SurfaceView, points: list[QPoint], keys: Qt.KeyboardModifier) -> None:
    mouse(shown, QEvent.Type.MouseMove, points[0], keys, held=False)
    mouse(shown, QEvent.Type.MouseButtonPress, points[0], keys, held=True)
    for one, other in itertools.pairwise(points):
        for part in range(1, 5):
            qtbot.wait(15)  # the map looks at the mouse a hundred times a second
            mouse(shown, QEvent.Type.MouseMove, one + (other - one) * part / 4, keys, held=True)
    mouse(shown, QEvent.Type.MouseButtonRelease, points[-1], keys, held=False)


def line_scene(end_mm: float = 4.5, amplitude: float = 1.0, **output: Any) -> SceneConfig:
    """A sine of 150 Hz that moves along the first row of the measured bank."""
    source = SourceTable(
        path=LineTable(start_mm=(0.0, 0.0), end_mm=(end_mm, 0.0)),
        signal=SineTable(frequency_hz=150.0, duration_s=0.2),
        speed_mm_s=30.0, step_mm=1.5, amplitude=amplitude, emission="continuous",
    )  # fmt: skip
    limits = Output(**{"interpolation": "nearest", **output})
    return SceneConfig(scene=SceneTable(name="line"), source=(source,), output=limits)
