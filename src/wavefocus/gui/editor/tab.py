"""The Files tab, and the editor of a text: completion, help and mistakes of its keys, and what the text means."""

from collections.abc import Sequence
from functools import partial
from html import escape
from pathlib import Path

import numpy as np
from PyQt5 import QtGui, QtWidgets
from PyQt5.QtCore import QEvent, QRegularExpression, QStringListModel, Qt

from wavefocus.acquisition.wording import hours
from wavefocus.config.editing import commented_table, completions, example, help_at
from wavefocus.config.fields import tables_of
from wavefocus.config.scene import PathTable, PointTable, SceneConfig, SignalTable, tables_by_kind
from wavefocus.gui import widgets as ui
from wavefocus.gui.editor.document import TextDocument, TextFiles, closing_question
from wavefocus.gui.files import FileKind
from wavefocus.gui.message_bar import error_text
from wavefocus.gui.scene.document import changed, new_source
from wavefocus.gui.surface import PlotSurface, plan_surface
from wavefocus.gui.surface_view import SurfaceView, rgba
from wavefocus.gui.tab import ClosingQuestion, Tab, TabContext
from wavefocus.gui.theme import Theme, Themed
from wavefocus.storage.errors import WavefocusError

_COMPLETER_KEYS = (Qt.Key.Key_Return, Qt.Key.Key_Enter, Qt.Key.Key_Tab, Qt.Key.Key_Escape)


class _TomlEdit(Themed, QtWidgets.QPlainTextEdit):
    """The text of a document. Letters complete keys; Ctrl+Space lists those that fit; a tooltip explains each."""

    def __init__(self, document: TextDocument) -> None:
        super().__init__()
        self._document = document
        self.setAccessibleName(f"Text of the {document.kind} file")
        self.setDocument(document.text)
        self.setFont(QtGui.QFontDatabase.systemFont(QtGui.QFontDatabase.SystemFont.FixedFont))
        self.setLineWrapMode(QtWidgets.QPlainTextEdit.LineWrapMode.NoWrap)  # comments stand in a column of their own
        self.setTabChangesFocus(True)  # whoever has no mouse gets out again
        self.setAcceptDrops(False)  # the name of a dropped file is no TOML
        self._colours = _Colours(document.text, self.theme)
        self._found = QStringListModel(self)
        self.completer = QtWidgets.QCompleter(self._found, self)
        self.completer.setWidget(self)
        popup = self.completer.popup()
        assert popup is not None
        self.popup = popup
        self.completer.setModelSorting(QtWidgets.QCompleter.ModelSorting.UnsortedModel)
        self.completer.activated[str].connect(self._complete)
        self._typed = ""
        document.changed.connect(self._mark_mistakes)

    def position(self) -> int:
        """Place of the cursor in the text, in characters."""
        return len(self._before(self.textCursor().position()))

    def go_to_line(self, line: int) -> None:
        """Put the cursor into a line, from 0."""
        self.setTextCursor(QtGui.QTextCursor(self._document.text.findBlockByNumber(line)))
        self.centerCursor()
        self.setFocus(Qt.FocusReason.OtherFocusReason)

    def _mark_mistakes(self) -> None:
        """Underline the lines with mistakes."""
        marked = []
        for mistake in self._document.mistakes:
            line = QtWidgets.QTextEdit.ExtraSelection()
            line.cursor = QtGui.QTextCursor(self._document.text.findBlockByNumber(mistake.line))
            line.cursor.select(QtGui.QTextCursor.SelectionType.LineUnderCursor)
            line.format.setUnderlineStyle(QtGui.QTextCharFormat.UnderlineStyle.WaveUnderline)
            line.format.setUnderlineColor(QtGui.QColor(self.theme.fault))
            marked.append(line)
        self.setExtraSelections(marked)

    def event(self, event: QEvent | None) -> bool:
        """Explain what is below the mouse: its mistake, else its key."""
        if not isinstance(event, QtGui.QHelpEvent):
            return bool(super().event(event))
        viewport = self.viewport()
        assert viewport is not None
        cursor = self.cursorForPosition(viewport.mapFromGlobal(event.globalPos()))
        wrong = [one.sentence for one in self._document.mistakes if one.line == cursor.blockNumber()]
        at = len(self._before(cursor.position()))
        QtWidgets.QToolTip.showText(
            event.globalPos(), "\n".join(wrong) or help_at(self._document.toml(), at, self._document.model)
        )
        return True

    def keyPressEvent(self, event: QtGui.QKeyEvent | None) -> None:  # noqa: N802
        assert event is not None
        if self.popup.isVisible() and event.key() in _COMPLETER_KEYS:
            event.ignore()  # for the list
            return
        asked = event.key() == Qt.Key.Key_Space and event.modifiers() == Qt.KeyboardModifier.ControlModifier
        if not asked:
            super().keyPressEvent(event)
        if asked or (event.text().isprintable() and event.text().strip() not in ("", "]", "}")):
            self._list_completions(asked=asked)
        else:
            self.popup.hide()

    def _list_completions(self, *, asked: bool) -> None:
        """List what may stand at the cursor; unless asked for, once a letter has been typed."""
        self._typed, found = completions(self._document.toml(), self.position(), self._document.model)
        popup = self.popup
        if not found or not (asked or self._typed) or found == [self._typed]:
            popup.hide()
            return
        self._found.setStringList(found)
        self.completer.setCompletionPrefix("")
        place = self.cursorRect()
        place.setWidth(popup.sizeHintForColumn(0) + 30)
        self.completer.complete(place)
        popup.setCurrentIndex(popup.indexAt(popup.rect().topLeft()))

    def _complete(self, text: str) -> None:
        cursor = self.textCursor()
        cursor.movePosition(
            QtGui.QTextCursor.MoveOperation.Left, QtGui.QTextCursor.MoveMode.KeepAnchor, len(self._typed)
        )
        cursor.insertText(text)
        self.setTextCursor(cursor)

    def _before(self, position: int) -> str:
        """The text before a position of Qt, which counts pairs of surrogates as two."""
        raw = self._document.toml().encode("utf-16-le", "surrogatepass")
        return raw[: 2 * position].decode("utf-16-le", "surrogatepass")


class _Colours(QtGui.QSyntaxHighlighter):
    """Headings, texts and comments."""

    def __init__(self, document: object, theme: Theme) -> None:
        super().__init__(document)  # type: ignore[call-overload]
        heading, text, comment = QtGui.QTextCharFormat(), QtGui.QTextCharFormat(), QtGui.QTextCharFormat()
        heading.setFontWeight(QtGui.QFont.Weight.Bold)
        text.setForeground(QtGui.QColor(theme.accent))
        comment.setForeground(QtGui.QColor(theme.faint))
        patterns = (r"^\s*\[+[\w.\-]+\]+", heading), (r'"[^"\n]*"', text), (r"#.*$", comment)
        self._rules = [(QRegularExpression(pattern), style) for pattern, style in patterns]

    def highlightBlock(self, line: str | None) -> None:  # noqa: N802
        for pattern, style in self._rules:
            found = pattern.globalMatch(line)
            while found.hasNext():
                match = found.next()
                self.setFormat(match.capturedStart(), match.capturedLength(), style)


class TextPanel(QtWidgets.QWidget):
    """The text with a line to search in it, and its mistakes below, each with its line."""

    def __init__(self, document: TextDocument) -> None:
        super().__init__()
        self._document = document
        self.text = _TomlEdit(document)
        self.search = ui.named(QtWidgets.QLineEdit(), "Enter: next place with this text (Ctrl+F)", "Search in the text")
        self.search.setPlaceholderText("search: Enter finds the next place")
        self.problem = ui.label("Mistakes of the text", role="fault", wraps=True)
        self.problem.setTextInteractionFlags(Qt.TextInteractionFlag.LinksAccessibleByMouse)
        self.problem.linkActivated.connect(lambda line: self.text.go_to_line(int(line)))
        ui.column(self.search, (self.text, 1), self.problem, owner=self, spacing=4)
        self.search.returnPressed.connect(self._find_next)
        seek = partial(self.search.setFocus, Qt.FocusReason.ShortcutFocusReason)
        find = ui.action(self, "&Find", seek, "Ctrl+F")
        find.setShortcutContext(Qt.ShortcutContext.WidgetWithChildrenShortcut)
        self.addAction(find)
        document.changed.connect(self._show_mistakes)
        self._show_mistakes()

    def _find_next(self) -> None:
        """Select the next place with the searched text, from the start after the last one."""
        if not self.text.find(self.search.text()):
            self.text.moveCursor(QtGui.QTextCursor.MoveOperation.Start)
            self.text.find(self.search.text())

    def _show_mistakes(self) -> None:
        shown = self._document.mistakes[:_MISTAKES_SHOWN]
        lines = [f'<a href="{one.line}">line {one.line + 1}</a>: {escape(one.sentence)}' for one in shown]
        if more := len(self._document.mistakes) - len(shown):
            lines.append(f"and {more} more")
        self.problem.setText("<br>".join(lines))
        self.problem.setVisible(bool(lines))


_MISTAKES_SHOWN = 3


class FileBar(QtWidgets.QWidget):
    """Buttons for a text and its file, and the file's name.

    owner: The widget in which their keys hold.
    """

    def __init__(self, owner: QtWidgets.QWidget, document: TextDocument, files: TextFiles) -> None:
        super().__init__()
        self._document, self._files = document, files
        text, kind = document.text, document.kind
        self.actions_by_name = {
            "new": ui.action(owner, "&New", files.new, "Ctrl+N", tip=f"Begin a new {kind} file"),
            "save": ui.action(owner, "&Save", files.save, "Ctrl+S", tip=f"Save the {kind} to its file"),
            "save as": ui.action(owner, "Save &as…", files.save_as, "Ctrl+Shift+S", tip="Save to another file"),
            "undo": ui.action(owner, "&Undo", text.undo, "Ctrl+Z", tip="Undo the last change"),
            "redo": ui.action(owner, "&Redo", text.redo, "Ctrl+Shift+Z", tip="Redo the change"),
        }
        for word, available in (("undo", text.undoAvailable), ("redo", text.redoAvailable)):
            available.connect(self.actions_by_name[word].setEnabled)
            self.actions_by_name[word].setEnabled(False)
        for action in self.actions_by_name.values():
            # Other tabs mean something else by the same keys.
            action.setShortcutContext(Qt.ShortcutContext.WidgetWithChildrenShortcut)
            owner.addAction(action)
        insert = ui.tool_button("Insert", "Insert a table with a comment for each of its keys")
        insert.setPopupMode(QtWidgets.QToolButton.ToolButtonPopupMode.InstantPopup)
        insert.setMenu(insert_menu(document))
        self.name = ui.label("File", any_width=True)
        self.name.setMinimumWidth(self.name.fontMetrics().horizontalAdvance("scene.toml •"))
        ui.row(*map(ui.button, self.actions_by_name.values()), insert, 6, (self.name, 1), owner=self)
        document.file_changed.connect(self._show_name)
        self._show_name()

    def _show_name(self) -> None:
        document = self._document
        self.name.setText(self._files.shown_name)
        self.name.setToolTip(str(document.path or "not in a file yet"))
        self.actions_by_name["save"].setEnabled(not document.saved or document.path is None)


def insert_menu(document: TextDocument) -> QtWidgets.QMenu:
    """A menu of the tables that a document's file can have."""
    menu = QtWidgets.QMenu("&Insert")
    if document.model is SceneConfig:
        for title, kinds, source in (
            ("Source on a &path", tables_by_kind(PathTable), source_on_path),
            ("Source with a &signal", tables_by_kind(SignalTable), source_with_signal),
        ):
            part = QtWidgets.QMenu(title, menu)
            for kind in kinds:
                part.addAction(ui.action(part, kind, partial(document.append, source(kind))))
            menu.addMenu(part)
    for heading in document.model.model_fields:
        if heading != "source" and tables_of(document.model, heading):
            text = commented_table(document.kind, heading)
            menu.addAction(ui.action(menu, f"[{heading}]", partial(document.append, text)))
    return menu


def source_on_path(kind: str) -> str:
    """A commented source on a path of a kind, which emits noise."""
    path = example(tables_by_kind(PathTable)[kind])
    source = new_source(path)  # type: ignore[arg-type]
    return commented_table("scene", "source", source, path=path, signal=source.signal)


def source_with_signal(kind: str) -> str:
    """A commented source with a signal of a kind, at rest."""
    source = new_source(PointTable(at_mm=(0.0, 0.0)))
    signal = example(tables_by_kind(SignalTable)[kind])
    return commented_table("scene", "source", changed(source, signal=signal), path=source.path, signal=signal)


# A surface with lines of text, and a table: titles and rows; both may be empty.
_Meaning = tuple[PlotSurface, Sequence[str], Sequence[str], Sequence[Sequence[str]]]


def _meaning_of_run(text: str, path: Path) -> _Meaning:
    """Grid, actuators and hours of a run. Raises InputError: The run cannot be carried out."""
    from wavefocus.acquisition.plan import schedule_name  # loads SciPy, and this runs in a thread
    from wavefocus.campaign.blueprint import blueprint_of
    from wavefocus.configuration import check_rows, load_run

    configuration = load_run(path, text)
    blueprint = blueprint_of(configuration)
    plan, rig = blueprint.plan, configuration.rig
    checks = check_rows(configuration)
    start_hz, stop_hz = plan.excitation.band_hz
    lines = [
        f"{plan.positions - len(checks)} positions on the grid, {len(checks)} check positions (rings), "
        f"{plan.actuators} actuators",
        f"{hours(plan.campaign_s(np.arange(plan.positions), rig.recorder))} in all; {schedule_name(plan)}, "
        f"{start_hz:g} to {stop_hz:g} Hz, {plan.excitation.amplitude_v:g} V",
        f"bank of {blueprint.bank_header().file_bytes / 1e6:.0f} MB",
    ]
    return plan_surface(rig, np.asarray(configuration.position_mm), checks), lines, (), ()


def _meaning_of_rig(text: str, path: Path) -> _Meaning:
    """Channels and limits of a rig. Raises InputError: The rig file is wrong."""
    from wavefocus.configuration import load_rig
    from wavefocus.rig.limits import limits_of

    rig = load_rig(path, text)
    player, limits = rig.player, limits_of(rig.player)
    rms = "" if limits.rms_v is None else f"{limits.rms_v:g} V"
    rows = [
        (str(actuator), f"{x_mm:g}, {y_mm:g}", str(channel), f"{player.output_full_scale_v[channel]:g} V",
         f"{limits.peak_v:g} V", rms)
        for actuator, ((x_mm, y_mm), channel) in enumerate(zip(rig.actuators.position_mm, player.channels, strict=True))
    ]  # fmt: skip
    rows.append(("loopback", "", str(player.loopback_channel), "", "", ""))
    instruments = ("mirror", "recorder", "player", "vibrometer")
    lines = [
        f"{len(player.channels)} actuators on a surface of {rig.surface.length_mm:g} × {rig.surface.width_mm:g} mm",
        "drivers: " + ", ".join(f"{name} {getattr(rig, name).driver}" for name in instruments),
    ]
    titles = ("actuator", "place (mm)", "channel", "full scale", "limit", "rms limit")
    return plan_surface(rig, np.asarray(rig.actuator_mm), ()), lines, titles, rows


MEANINGS = {"run": _meaning_of_run, "rig": _meaning_of_rig}


_KINDS = {FileKind.RUN: "run", FileKind.RIG: "rig"}


class _FilePage(Themed, QtWidgets.QWidget):
    """The text of a run or rig file, and what it means."""

    def __init__(self, kind: str, context: TabContext, owner: QtWidgets.QWidget) -> None:
        super().__init__()
        self._context = context
        self.document = TextDocument(kind, self)
        self.files = TextFiles(context, self.document, owner)
        self.editor = TextPanel(self.document)
        self.surface = SurfaceView(f"Surface of the {kind} file")
        self.lines = ui.label("Meaning of the text", wraps=True, selectable=True)
        self.lines.setMinimumHeight(3 * self.lines.fontMetrics().lineSpacing())
        self.table = ui.table(("",), "Channels and limits", ())
        self.table.hide()
        self.bar = FileBar(self, self.document, self.files)
        right = QtWidgets.QWidget()
        ui.column((self.surface, 2), self.lines, (self.table, 1), owner=right, spacing=4)
        self.columns = ui.side_by_side((self.editor, 620), (right, 600), growing=[0, 1])
        ui.column(self.bar, (self.columns, 1), owner=self, spacing=4)
        self.document.changed.connect(self._ask)

    def showEvent(self, event: QtGui.QShowEvent | None) -> None:  # noqa: N802
        super().showEvent(event)
        self._ask()

    def _ask(self) -> None:
        """Find out in a thread what the text means, while it is shown."""
        document = self.document
        self.lines.setEnabled(not document.mistakes)  # else it is the meaning of an earlier text
        if not self.isVisible() or document.mistakes or not document.worth_keeping:
            return
        work = partial(MEANINGS[document.kind], document.toml(), document.place)
        self._context.background.ask(f"{document.kind} text", work, self._show, self._refuse)

    def _show(self, meaning: _Meaning) -> None:
        surface, lines, titles, rows = meaning
        self.surface.show_surface(surface)
        shown = rgba(self.theme.cell) if self.document.kind == "run" else np.zeros(4, np.uint8)
        self.surface.paint(np.tile(shown, (surface.positions, 1)))
        self.lines.setText("\n".join(lines))
        self.table.setColumnCount(len(titles))
        self.table.setHorizontalHeaderLabels(list(titles))
        self.table.setRowCount(len(rows))
        for number, row in enumerate(rows):
            ui.fill_row(self.table, number, row)
        self.table.setVisible(bool(rows))
        self.lines.setStyleSheet("")

    def _refuse(self, failure: Exception) -> None:
        """Say what is wrong with the files together; the surface stays."""
        if not isinstance(failure, WavefocusError | OSError):
            raise failure
        self.lines.setText(error_text(failure).removeprefix(f"{self.document.place}: "))
        self.lines.setStyleSheet(f"QLabel {{ color: {self.theme.fault}; }}")


class FilesTab(Tab):
    """Edits run and rig file; scenes have their own tab."""

    title = "Files"

    def __init__(self, context: TabContext) -> None:
        super().__init__(context)
        self.pages = {kind: _FilePage(name, context, self) for kind, name in _KINDS.items()}
        self._pages = ui.tab_pages("Files", {kind.capitalize(): page for kind, page in self.pages.items()})
        ui.column(self._pages, owner=self, margins=ui.PAGE_MARGINS)
        self.remember(**{f"{name}_columns": self.pages[kind].columns for kind, name in _KINDS.items()})
        for page in self.pages.values():
            page.files.restore_unsaved()

    def menu_actions(self) -> list[QtWidgets.QAction | None]:
        return [ui.action(self, f"&{kind.capitalize()}", partial(self.show_page, kind)) for kind in _KINDS]

    def show_page(self, kind: FileKind) -> None:
        """Show the run file or the rig file."""
        self._pages.setCurrentWidget(self.pages[kind])
        stack = self.parentWidget()
        tabs = None if stack is None else stack.parentWidget()
        if isinstance(tabs, QtWidgets.QTabWidget):
            tabs.setCurrentWidget(self)

    def use_shared(self, kind: FileKind, path: Path) -> None:
        """Show the run and rig file of the other tabs; a text with unsaved changes stays."""
        page = self.pages.get(kind)
        if page is not None and page.document.saved and page.document.path != path:
            page.files.show(path)

    def closing_question(self) -> ClosingQuestion | None:
        return closing_question(self.context, [page.files for page in self.pages.values()])

    def save_settings(self) -> None:
        super().save_settings()
        for page in self.pages.values():
            page.files.save_settings()
