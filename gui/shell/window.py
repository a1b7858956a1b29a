"""The window: tabs, menus, messages, files that are dropped on it, and what happens when it is closed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from PyQt5.QtCore import QSize, Qt, QTimer
from PyQt5.QtGui import QCloseEvent, QDragEnterEvent, QDropEvent, QGuiApplication, QKeySequence
from PyQt5.QtWidgets import (
    QAction,
    QActionGroup,
    QApplication,
    QFileDialog,
    QFrame,
    QMainWindow,
    QMenu,
    QScrollArea,
    QTabWidget,
    QVBoxLayout,
    QWidget,
)

from gui.process.background import Background
from gui.shell.error_hook import ErrorHook
from gui.shell.file_choice import dropped_files, make_dialog
from gui.shell.front_door import FrontDoor
from gui.shell.message_bar import MessageBar
from gui.shell.settings import Settings
from gui.shell.tab import Act, Question, Tab, TabContext, make_tabs
from gui.shell.theme import CHOICES, resized_text, set_theme, theme_named
from gui.shell.widgets import copy_text, make_action

DRAWS_EVERY_MS = 50
_SIZE, _LEAST, _FRAME = QSize(1240, 720), QSize(800, 560), QSize(16, 48)
_MISHAPS_KEPT = 20


class Window(QMainWindow):
    """The whole window.

    Parameters
    ----------
    front : FrontDoor
        Starts commands, names files.
    settings : Settings
        What is remembered.
    """

    def __init__(self, front: FrontDoor, settings: Settings) -> None:
        super().__init__()
        self.settings = settings
        self.setWindowTitle("wavefocus")
        self.setAcceptDrops(True)
        self.messages = MessageBar()
        self.background = Background(self)
        self.context = TabContext(front, self.messages, self.background, settings, self)
        self._unexpected = ErrorHook(self.tell_unexpected, self.close)
        self._unexpected.install()
        application = QApplication.instance()
        assert isinstance(application, QApplication)
        self._application = application
        self._system_palette = application.palette()
        self._may_close = False
        self.mishaps: list[str] = []
        self._let_go = False
        set_theme(application, theme_named(settings.text("theme", "system"), self._system_palette))
        self.tabs = self.context.tabs
        self.tabs += make_tabs(self.context)
        self._pages = QTabWidget()
        self._pages.setDocumentMode(True)
        self._pages.setAccessibleName("Tabs")
        for tab in self.tabs:
            self._pages.addTab(tab, tab.title)
        centre = QWidget()
        column = QVBoxLayout(centre)
        column.setContentsMargins(6, 6, 6, 6)
        column.addWidget(self.messages)
        # Where text is large or the screen small, what the tabs need is scrolled: the window never outgrows its screen.
        scrolled = QScrollArea()
        scrolled.setFrameShape(QFrame.Shape.NoFrame)
        scrolled.setWidgetResizable(True)
        scrolled.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        scrolled.setWidget(self._pages)
        column.addWidget(scrolled, stretch=1)
        self.setCentralWidget(centre)
        self._recent = QMenu("Open &recent", self)
        self._make_menus()
        self._text_size = settings.whole("text_pt", application.font().pointSize())
        self._resize_text(self._text_size - application.font().pointSize())
        self.choose_theme(settings.text("theme", "system"))
        if not self.restoreGeometry(settings.bytes("geometry")):
            self._fit_screen()
        self._timer = QTimer(self)
        self._timer.timeout.connect(self.refresh)
        self._timer.start(DRAWS_EVERY_MS)

    def _fit_screen(self) -> None:
        """Take a size that a screen of 1280 x 800 has room for, frame and panel included; less on a smaller one."""
        screen = QGuiApplication.primaryScreen()
        room = _SIZE if screen is None else screen.availableSize() - _FRAME
        self.resize(_SIZE.boundedTo(room.expandedTo(_LEAST)))

    def refresh(self) -> None:
        """Let tabs take up what came in, and draw what is seen."""
        for tab in self.tabs:
            tab.poll()
        shown = self._pages.currentWidget()
        if isinstance(shown, Tab) and self.isVisible() and not self.isMinimized():
            shown.draw()

    def open_file(self, path: Path) -> None:
        """Open a file in the tab that it belongs to."""
        path = path.absolute()
        self.messages.dismiss_old()
        for tab in self.tabs:
            if tab.accepts(path):
                self._pages.setCurrentWidget(tab)
                tab.open_file(path)
                self.settings.opened(path)
                return
        self.messages.warn(f"{path}: no tab opens such a file; they open {', '.join(self._endings())}")

    def restore_settings(self) -> None:
        """Open what was open last time."""
        for tab in self.tabs:
            tab.restore_settings()

    def tell_unexpected(self, sentence: str, details: str) -> None:
        """Tell an error that nobody caught."""
        if not details:
            self.messages.fault(sentence)
            return
        self.mishaps = [*self.mishaps[-_MISHAPS_KEPT:], details]
        self.messages.fault(sentence, ("Copy details", lambda: copy_text(details)))

    def choose_theme(self, choice: str) -> None:
        """Dress everything."""
        theme = theme_named(choice, self._system_palette)
        set_theme(self._application, theme)
        self.messages.apply_theme(theme)
        for tab in self.tabs:
            tab.apply_theme(theme)
        self.settings.keep("theme", choice)

    def closeEvent(self, event: QCloseEvent | None) -> None:  # noqa: N802
        """Ask first what tabs have to ask, one after the other, inside the window."""
        assert event is not None
        questions = (
            [] if self._may_close else [asked for tab in self.tabs if (asked := tab.closing_question()) is not None]
        )
        if not questions:
            self.settings.keep("geometry", self.saveGeometry())
            for tab in self.tabs:
                tab.save_settings()
            self.let_go()
            event.accept()
            return
        event.ignore()
        self._ask(questions, [])

    def close_at_once(self) -> None:
        """Close without a question; a run of this window's own goes on."""
        self._may_close = True
        self.close()

    def let_go(self) -> None:
        """End threads and timers; may be called twice."""
        if self._let_go:
            return
        self._let_go = True
        self._timer.stop()
        for tab in self.tabs:
            tab.shut_down()
        self.background.end()
        self._unexpected.remove()

    def dragEnterEvent(self, event: QDragEnterEvent | None) -> None:  # noqa: N802
        """Take files that a tab opens."""
        if event is not None and any(tab.accepts(path) for path in dropped_files(event) for tab in self.tabs):
            event.acceptProposedAction()

    def dropEvent(self, event: QDropEvent | None) -> None:  # noqa: N802
        """Open what was dropped."""
        if event is not None:
            event.acceptProposedAction()
            for path in dropped_files(event):
                self.open_file(path)

    def _ask(self, questions: Sequence[Question], chosen: Sequence[Act]) -> None:
        """Ask what is left, and only then do what was chosen: whoever does not close after all has lost nothing."""
        if not questions:
            self._carry_out(chosen)
            return
        question, *others = questions
        self.messages.ask(
            question.sentence,
            *((word, partial(self._ask, others, [*chosen, act])) for word, act in question.answers),
            ("Do not close", lambda: None),
        )

    def _carry_out(self, chosen: Sequence[Act]) -> None:
        if not chosen:
            self.close_at_once()
            return
        act, *others = chosen
        act(partial(self._carry_out, others))

    def _make_menus(self) -> None:
        bar = self.menuBar()
        assert bar is not None
        files = _menu(bar.addMenu("&File"))
        _add(files, "&Open…", self._choose_file, QKeySequence.StandardKey.Open)
        files.addMenu(self._recent)
        self._recent.aboutToShow.connect(self._list_recent)
        files.addSeparator()
        _add(files, "&Quit", self.close, "Ctrl+Q")
        for tab in self.tabs:
            own = _menu(bar.addMenu(f"&{tab.title}"))
            for action in tab.menu_actions():
                own.addSeparator() if action is None else own.addAction(action)
        view = _menu(bar.addMenu("&View"))
        group = QActionGroup(self)
        for choice in CHOICES:
            words = {"system": "Colours as the &desktop", "light": "&Light", "dark": "&Dark"}[choice]
            action = _add(view, words, partial(self.choose_theme, choice))
            action.setCheckable(True)
            action.setChecked(self.settings.text("theme", "system") == choice)
            group.addAction(action)
        view.addSeparator()
        _add(view, "L&arger text", lambda: self._resize_text(1), QKeySequence.StandardKey.ZoomIn)
        _add(view, "&Smaller text", lambda: self._resize_text(-1), QKeySequence.StandardKey.ZoomOut)
        view.addSeparator()
        for index, tab in enumerate(self.tabs):
            _add(view, tab.title, partial(self._pages.setCurrentIndex, index), f"Alt+{index + 1}")

    def _choose_file(self) -> None:
        dialog = make_dialog(self, "Open", self.settings.folder(".h5"), "What the window opens", self._endings())
        dialog.setNameFilters([*dialog.nameFilters(), "All files (*)"])
        dialog.setFileMode(QFileDialog.FileMode.ExistingFiles)
        dialog.filesSelected.connect(self._open_named)
        dialog.show()

    def _endings(self) -> list[str]:
        return list(dict.fromkeys(ending for tab in self.tabs for ending in tab.opens))

    def _open_named(self, names: list[str]) -> None:
        for name in names:
            self.open_file(Path(name))

    def _list_recent(self) -> None:
        self._recent.clear()
        for path in self.settings.recent():
            _add(self._recent, str(path), partial(self.open_file, path))
        self._recent.addSeparator()
        _add(self._recent, "&Forget these", self.settings.forget_recent)

    def _resize_text(self, step: int) -> None:
        self.settings.keep("text_pt", resized_text(self._application, step))


def _menu(menu: QMenu | None) -> QMenu:
    assert menu is not None
    return menu


def _add(menu: QMenu, words: str, act: Callable[[], object], *keys: QKeySequence.StandardKey | str) -> QAction:
    action = make_action(menu, words, act, *keys)
    menu.addAction(action)
    return action
