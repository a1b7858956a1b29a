"""The application and its window: tabs, menus, messages, closing."""

import signal
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from PyQt5.QtCore import QSize, Qt, QTimer
from PyQt5.QtGui import QCloseEvent, QFontDatabase, QGuiApplication, QKeySequence
from PyQt5.QtWidgets import QApplication, QFileDialog, QMainWindow, QMenu, QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.files import ENDINGS, FileKind, Settings, kind_of, make_dialog, short_path
from wavefocus.gui.message_bar import ErrorHook, MessageBar
from wavefocus.gui.process import Background, CommandProcess
from wavefocus.gui.surface import VIRTUAL
from wavefocus.gui.tab import Act, ClosingQuestion, OwnCommand, Tab, TabContext, one_by_one
from wavefocus.gui.theme import BoxStyle, use_desktop_theme
from wavefocus.storage.errors import InputError

_SIZE, _FRAME = QSize(1240, 720), QSize(16, 48)
_LAB = "lab"
# Holds docs and, once it is built, the site made of them.
_ROOT = Path(__file__).resolve().parents[3]


class Window(QMainWindow):
    """The whole window."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self.settings = settings
        self.setWindowTitle("wavefocus")
        self.messages = MessageBar()
        self.background = Background(self)
        self.context = TabContext(self.messages, self.background, settings, self)
        self._error_hook = ErrorHook(self._report_error, self.close)
        application = QApplication.instance()
        assert isinstance(application, QApplication)
        use_desktop_theme(application)
        self._may_close = self._shut_down = False
        self.tracebacks: list[str] = []
        """Tracebacks of the last errors that nobody caught."""
        self.tabs = self.context.tabs
        self.tabs += _make_tabs(self.context)
        self._pages = ui.tab_pages("Tabs", {tab.title: tab for tab in self.tabs})
        scrolled = ui.scrolling(self._pages)  # with large text or a small screen: the window never outgrows its screen
        scrolled.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        centre = QWidget()
        # Messages stand below: no strip above the tabs is blank while there is none, and no control moves.
        ui.column((scrolled, 1), self.messages, owner=centre, margins=(6, 2, 6, 4), spacing=4)
        self.setCentralWidget(centre)
        self._pages.currentChanged.connect(lambda _index: self.context.settle("file"))
        self._recent = QMenu("Open &recent", self)
        self._make_menus()
        if not self.restoreGeometry(settings.bytes("geometry")):
            screen = QGuiApplication.primaryScreen()
            room = _SIZE if screen is None else screen.availableSize() - _FRAME
            self.resize(_SIZE.boundedTo(room))
        self._timer = QTimer(self)
        self._timer.timeout.connect(self.refresh)
        self._timer.start(50)

    def refresh(self) -> None:
        for tab in self.tabs:
            tab.poll()
        shared = self.context.shared
        files = "   ·   ".join(f"{kind}: {short_path(shared[kind])}" for kind in FileKind if kind in shared)
        self.messages.show_idle(files or "File > New lab writes the files to begin with; File > Open opens yours")
        shown = self._pages.currentWidget()
        if isinstance(shown, Tab) and self.isVisible() and not self.isMinimized():
            shown.draw()

    def open_file(self, path: Path) -> None:
        """Open a file in the tab that accepts it."""
        path = path.absolute()
        self.messages.dismiss_old()
        kind = kind_of(path)
        if kind is None and path.suffix.lower() == ".toml":
            kind = FileKind.RUN  # the capture reports what is wrong with it
        tab = next((one for one in self.tabs if kind in one.kinds), None)
        if tab is not None:
            self._pages.setCurrentWidget(tab)
            tab.open_file(path)
            self.settings.opened(path)
        elif kind is FileKind.TRIALS:
            self._open_trials(path)
        else:
            self.messages.warn(f"{path}: no tab opens such a file; they open {', '.join(ENDINGS)}")

    def restore_settings(self) -> None:
        for tab in self.tabs:
            tab.restore_settings()

    def _report_error(self, sentence: str, details: str) -> None:
        """Report an error that nobody caught; `details` holds the traceback of a defect."""
        if details:
            self.tracebacks = [*self.tracebacks[-20:], details]
        self.messages.fault(sentence, details=details)

    def closeEvent(self, event: QCloseEvent | None) -> None:  # noqa: N802
        """Ask the questions of the tabs first, one after the other."""
        assert event is not None
        askers: list[OwnCommand | Tab] = [*self.context.commands, *self.tabs]
        asked = [one.closing_question() for one in askers]
        if (questions := [question for question in asked if question is not None]) and not self._may_close:
            event.ignore()
            self._ask(questions, [])
            return
        self.settings.keep("geometry", self.saveGeometry())
        for tab in self.tabs:
            tab.save_settings()
        self.shut_down()
        event.accept()

    def close_at_once(self) -> None:
        """Close without a question; a capture of this window continues."""
        self._may_close = True
        self.close()

    def shut_down(self) -> None:
        """End threads and timers; may be called twice."""
        if self._shut_down:
            return
        self._shut_down = True
        self._timer.stop()
        for tab in self.tabs:
            tab.shut_down()
        for command in self.context.commands:
            command.detach()
        for process in self.findChildren(CommandProcess):  # an order, for one
            process.detach()
        self.background.end()
        self._error_hook.remove()

    def _ask(self, questions: Sequence[ClosingQuestion], chosen: Sequence[Act]) -> None:
        """Ask all questions before any answer is carried out, so that "Do not close" loses nothing."""
        if not questions:
            one_by_one(chosen, self.close_at_once)
            return
        (sentence, answers), *others = questions
        acts = [(word, partial(self._ask, others, [*chosen, act])) for word, act in answers]
        self.messages.ask(sentence, *acts, ("Do not close", lambda: None))

    def _make_menus(self) -> None:
        bar = self.menuBar()
        assert bar is not None
        files = QMenu("&File", self)
        files.addAction(ui.action(files, "New &lab…", self._choose_lab, "Ctrl+Shift+N"))
        files.addAction(ui.action(files, "&Open…", self._choose_file, QKeySequence.StandardKey.Open))
        files.addMenu(self._recent)
        self._recent.aboutToShow.connect(self._list_recent)
        files.addSeparator()
        files.addAction(ui.action(files, "&Quit", self.close, "Ctrl+Q"))
        bar.addMenu(files)
        for tab in self.tabs:
            menu = QMenu(tab.title, self)  # its letter is one of the page's
            for action in tab.menu_actions():
                menu.addSeparator() if action is None else menu.addAction(action)
            bar.addMenu(menu)
        help_menu = QMenu("&Help", self)
        help_menu.addAction(
            ui.action(help_menu, "&Documentation", self._open_documentation, QKeySequence.StandardKey.HelpContents)
        )
        bar.addMenu(help_menu)

    def _choose_file(self) -> None:
        dialog = make_dialog(self, "Open", self.settings.folder(".h5"), "Files of wavefocus", ENDINGS)
        dialog.setNameFilters([*dialog.nameFilters(), "All files (*)"])
        dialog.setFileMode(QFileDialog.FileMode.ExistingFiles)
        dialog.filesSelected.connect(self._open_named)
        dialog.show()

    def _choose_lab(self) -> None:
        """Choose a new folder for the files of a lab."""
        folder = self.settings.folder(_LAB)
        dialog = make_dialog(self, "New lab: name a new folder", folder, "Folders", [""])
        dialog.setAcceptMode(QFileDialog.AcceptMode.AcceptSave)
        dialog.setLabelText(QFileDialog.DialogLabel.FileName, "New &folder:")
        dialog.setLabelText(QFileDialog.DialogLabel.Accept, "Create")
        dialog.selectFile("lab")
        dialog.fileSelected.connect(lambda name: self._ask_for_rig(Path(name)))
        dialog.show()

    def _ask_for_rig(self, folder: Path) -> None:
        self.messages.ask(
            f"New lab in {folder}: with the virtual rig, to try everything without instruments, or with your own?",
            ("Virtual rig", partial(self._make_lab, folder, "virtual")),
            ("Own instruments", partial(self._make_lab, folder, "template")),
            ("Cancel", lambda: None),
        )

    def _make_lab(self, folder: Path, rig: str) -> None:
        """Write the files of a lab, as ``wavefocus init`` does, and open them."""

        def written(process: CommandProcess) -> None:
            if process.failure:
                self.context.report_end(process)
                return
            self.settings.keep(f"folder/{_LAB}", str(folder.parent))
            names = ("scene.toml", "rig.toml", "run.toml") if rig == VIRTUAL else ("scene.toml", "run.toml", "rig.toml")
            for name in names:
                self.open_file(folder / name)
            own = "fill in rig.toml, save it, then Examine asks each instrument"
            nexts = "Start measures it" if rig == VIRTUAL else own
            self.messages.note(f"the lab is in {folder}; {nexts}")

        process = CommandProcess(["init", str(folder), "--rig", rig], self)
        process.finished.connect(lambda: written(process))

    def _open_named(self, names: Sequence[str]) -> None:
        for name in names:
            self.open_file(Path(name))

    def _list_recent(self) -> None:
        self._recent.clear()
        for path in self.settings.recent():
            self._recent.addAction(ui.action(self._recent, str(path), partial(self.open_file, path)))

    def _open_trials(self, path: Path) -> None:
        from wavefocus.gui.trials.start import TrialsStart

        self.settings.opened(path)
        TrialsStart(self.context, path, self).show()

    def _open_documentation(self) -> None:
        """Open the pages that lie beside the program: the built site, or the text that it is built from."""
        pages = [_ROOT / "site" / "index.html", _ROOT / "docs" / "README.md"]
        page = next((one for one in pages if one.is_file()), None)
        if page is None:
            self.messages.warn(f"{_ROOT}: holds no docs; get the source of wavefocus, and run make docs there")
        else:
            self.context.open_outside(page)


def _make_tabs(context: TabContext) -> list[Tab]:
    """Make every tab, from left to right; the window of trials, which shares this module, needs none of them."""
    from wavefocus.gui.campaign.tab import CampaignTab
    from wavefocus.gui.editor.tab import FilesTab
    from wavefocus.gui.rig.tab import RigTab
    from wavefocus.gui.scene.tab import SceneTab
    from wavefocus.gui.verification.tab import VerificationTab

    return [kind(context) for kind in (CampaignTab, RigTab, FilesTab, SceneTab, VerificationTab)]


# Fontconfig's own names, which Qt lists even without fonts.
_NAMES_WITHOUT_FONTS = {"Monospace", "Sans Serif", "Serif"}


def make_application(arguments: Sequence[str] = ("wavefocus",)) -> QApplication:
    """Make the application, sharp at any scaling.

    Raises InputError: The system has no font: Qt would show no text.
    """
    QApplication.setAttribute(Qt.ApplicationAttribute.AA_EnableHighDpiScaling, True)
    QApplication.setAttribute(Qt.ApplicationAttribute.AA_UseHighDpiPixmaps, True)
    QGuiApplication.setHighDpiScaleFactorRoundingPolicy(Qt.HighDpiScaleFactorRoundingPolicy.PassThrough)
    application = QApplication(list(arguments))
    application.setApplicationName("wavefocus")
    application.setApplicationDisplayName("wavefocus")
    application.setStyle(BoxStyle())
    require_fonts()
    return application


def require_fonts() -> None:
    """Refuse where Qt finds no font.

    Raises InputError: There is none.
    """
    if not set(QFontDatabase().families()) - _NAMES_WITHOUT_FONTS:
        raise InputError(
            "the window would show no text, for the system has no font: install one, on Debian and Ubuntu: "
            "sudo apt-get install fonts-dejavu-core"
        )


def show(files: Sequence[Path]) -> int:
    """Show the window until it is closed."""
    application = make_application()
    window = Window(Settings())
    for path in files:
        window.open_file(path)
    if not files:
        window.restore_settings()
    window.show()
    former = signal.signal(signal.SIGTERM, lambda _number, _frame: window.close_at_once())
    try:
        return int(application.exec_())
    finally:
        signal.signal(signal.SIGTERM, former)
        window.shut_down()
