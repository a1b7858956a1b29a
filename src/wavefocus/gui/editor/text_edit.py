"""The editor of a text: completion of keys, their help, mistakes at their lines, and the menu that inserts tables."""

from functools import partial

from PyQt5.QtCore import QEvent, QRegularExpression, QStringListModel, Qt, pyqtSignal
from PyQt5.QtGui import (
    QColor,
    QFont,
    QFontDatabase,
    QHelpEvent,
    QKeyEvent,
    QSyntaxHighlighter,
    QTextCharFormat,
    QTextCursor,
)
from PyQt5.QtWidgets import QCompleter, QLineEdit, QMenu, QPlainTextEdit, QTextEdit, QToolButton, QToolTip, QWidget

from wavefocus.config.editing import commented_table, completions, example, help_at
from wavefocus.config.fields import tables_of
from wavefocus.config.scene import PathTable, PointTable, SceneConfig, SignalTable, tables_by_kind
from wavefocus.gui import widgets as ui
from wavefocus.gui.editor.document import TextDocument, TextFiles
from wavefocus.gui.scene.document import changed, new_source
from wavefocus.gui.theme import Theme, Themed

_COMPLETER_KEYS = (Qt.Key.Key_Return, Qt.Key.Key_Enter, Qt.Key.Key_Tab, Qt.Key.Key_Escape)


class _TomlEdit(Themed, QPlainTextEdit):
    """The text of a document. Letters complete keys; Ctrl+Space lists those that fit; a tooltip explains each."""

    def __init__(self, document: TextDocument) -> None:
        super().__init__()
        self._document = document
        self.setAccessibleName(f"Text of the {document.kind} file")
        self.setDocument(document.text)
        self.setFont(QFontDatabase.systemFont(QFontDatabase.SystemFont.FixedFont))
        self.setLineWrapMode(QPlainTextEdit.LineWrapMode.NoWrap)  # comments stand in a column of their own
        self.setTabChangesFocus(True)  # whoever has no mouse gets out again
        self.setAcceptDrops(False)  # the name of a dropped file is no TOML
        self._colours = _Colours(document.text, self.theme)
        self._found = QStringListModel(self)
        self.completer = QCompleter(self._found, self)
        self.completer.setWidget(self)
        popup = self.completer.popup()
        assert popup is not None
        self.popup = popup
        self.completer.setModelSorting(QCompleter.ModelSorting.UnsortedModel)
        self.completer.activated[str].connect(self._complete)
        self._typed = ""
        document.changed.connect(self._mark_mistakes)

    def position(self) -> int:
        """Place of the cursor in the text, in characters."""
        return len(self._before(self.textCursor().position()))

    def go_to_line(self, line: int) -> None:
        """Put the cursor into a line, from 0."""
        self.setTextCursor(QTextCursor(self._document.text.findBlockByNumber(line)))
        self.centerCursor()
        self.setFocus(Qt.FocusReason.OtherFocusReason)

    def _mark_mistakes(self) -> None:
        """Underline the lines with mistakes."""
        marked = []
        for mistake in self._document.mistakes:
            line = QTextEdit.ExtraSelection()
            line.cursor = QTextCursor(self._document.text.findBlockByNumber(mistake.line))
            line.cursor.select(QTextCursor.SelectionType.LineUnderCursor)
            line.format.setUnderlineStyle(QTextCharFormat.UnderlineStyle.WaveUnderline)
            line.format.setUnderlineColor(QColor(self.theme.fault))
            marked.append(line)
        self.setExtraSelections(marked)

    def event(self, event: QEvent | None) -> bool:
        """Explain what is below the mouse: its mistake, else its key."""
        if not isinstance(event, QHelpEvent):
            return bool(super().event(event))
        viewport = self.viewport()
        assert viewport is not None
        cursor = self.cursorForPosition(viewport.mapFromGlobal(event.globalPos()))
        wrong = [one.sentence for one in self._document.mistakes if one.line == cursor.blockNumber()]
        at = len(self._before(cursor.position()))
        QToolTip.showText(
            event.globalPos(), "\n".join(wrong) or help_at(self._document.toml(), at, self._document.model)
        )
        return True

    def keyPressEvent(self, event: QKeyEvent | None) -> None:  # noqa: N802
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
        cursor.movePosition(QTextCursor.MoveOperation.Left, QTextCursor.MoveMode.KeepAnchor, len(self._typed))
        cursor.insertText(text)
        self.setTextCursor(cursor)

    def _before(self, position: int) -> str:
        """The text before a position of Qt, which counts pairs of surrogates as two."""
        raw = self._document.toml().encode("utf-16-le", "surrogatepass")
        return raw[: 2 * position].decode("utf-16-le", "surrogatepass")


class _Colours(QSyntaxHighlighter):
    """Headings, texts and comments."""

    def __init__(self, document: object, theme: Theme) -> None:
        super().__init__(document)  # type: ignore[call-overload]
        heading, text, comment = QTextCharFormat(), QTextCharFormat(), QTextCharFormat()
        heading.setFontWeight(QFont.Weight.Bold)
        text.setForeground(QColor(theme.accent))
        comment.setForeground(QColor(theme.faint))
        patterns = (r"^\s*\[+[\w.\-]+\]+", heading), (r'"[^"\n]*"', text), (r"#.*$", comment)
        self._rules = [(QRegularExpression(pattern), style) for pattern, style in patterns]

    def highlightBlock(self, line: str | None) -> None:  # noqa: N802
        for pattern, style in self._rules:
            found = pattern.globalMatch(line)
            while found.hasNext():
                match = found.next()
                self.setFormat(match.capturedStart(), match.capturedLength(), style)


class _SearchLine(QLineEdit):
    """Takes Escape itself, also while a message is shown that Escape would dismiss."""

    left = pyqtSignal()

    def event(self, event: QEvent | None) -> bool:
        """Claim Escape before it is taken for a shortcut."""
        if isinstance(event, QKeyEvent) and event.key() == Qt.Key.Key_Escape:
            event.accept()
            if event.type() == QEvent.Type.KeyPress:
                self.left.emit()
            return True
        return bool(super().event(event))


class TextPanel(Themed, QWidget):
    """The text with a line to search in it, and its mistakes below, each with its line."""

    def __init__(self, document: TextDocument) -> None:
        super().__init__()
        self._document = document
        self.text = _TomlEdit(document)
        self.search = ui.named(_SearchLine(), "Enter: next place, Escape: close", "Search in the text")
        self.search.setPlaceholderText("search: Enter finds the next place")
        self.search.hide()
        self.problem = ui.label("Mistakes of the text", wraps=True, selectable=True)
        self.problem.setTextInteractionFlags(Qt.TextInteractionFlag.LinksAccessibleByMouse)
        self.problem.linkActivated.connect(lambda line: self.text.go_to_line(int(line)))
        ui.column(self.search, (self.text, 1), self.problem, owner=self, spacing=4)
        self.search.returnPressed.connect(self._find_next)
        find = ui.action(self, "&Find", self._find, "Ctrl+F")
        find.setShortcutContext(Qt.ShortcutContext.WidgetWithChildrenShortcut)
        self.addAction(find)
        self.search.left.connect(self._leave)
        document.changed.connect(self._show_mistakes)
        self.problem.setStyleSheet(f"QLabel {{ color: {self.theme.fault}; }}")
        self._show_mistakes()

    def _find_next(self) -> None:
        """Select the next place with the searched text, from the start after the last one."""
        if not self.text.find(self.search.text()):
            self.text.moveCursor(QTextCursor.MoveOperation.Start)
            self.text.find(self.search.text())

    def _show_mistakes(self) -> None:
        shown = self._document.mistakes[:_MISTAKES_SHOWN]
        lines = [f'<a href="{one.line}">line {one.line + 1}</a>: {_escaped(one.sentence)}' for one in shown]
        if more := len(self._document.mistakes) - len(shown):
            lines.append(f"and {more} more")
        self.problem.setText("<br>".join(lines))
        self.problem.setVisible(bool(lines))

    def _find(self) -> None:
        self.search.show()
        self.search.setFocus(Qt.FocusReason.ShortcutFocusReason)
        self.search.selectAll()

    def _leave(self) -> None:
        self.search.hide()
        self.text.setFocus(Qt.FocusReason.OtherFocusReason)


_MISTAKES_SHOWN = 3


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;")


class FileBar(QWidget):
    """Buttons for a text and its file, and the file's name.

    owner: The widget in which their keys hold.
    """

    def __init__(self, owner: QWidget, document: TextDocument, files: TextFiles) -> None:
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
        text.undoAvailable.connect(self.actions_by_name["undo"].setEnabled)
        text.redoAvailable.connect(self.actions_by_name["redo"].setEnabled)
        for action in self.actions_by_name.values():
            # Other tabs mean something else by the same keys.
            action.setShortcutContext(Qt.ShortcutContext.WidgetWithChildrenShortcut)
            owner.addAction(action)
        insert = ui.tool_button("Insert", "Insert a table with a comment for each of its keys")
        insert.setPopupMode(QToolButton.ToolButtonPopupMode.InstantPopup)
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


def insert_menu(document: TextDocument) -> QMenu:
    """A menu of the tables that a document's file can have."""
    menu = QMenu("&Insert")
    if document.model is SceneConfig:
        for title, kinds, source in (
            ("Source on a &path", tables_by_kind(PathTable), source_on_path),
            ("Source with a &signal", tables_by_kind(SignalTable), source_with_signal),
        ):
            part = QMenu(title, menu)
            for kind in kinds:
                _add(part, document, kind, source(kind))
            menu.addMenu(part)
    for heading in document.model.model_fields:
        if heading != "source" and tables_of(document.model, heading):
            _add(menu, document, f"[{heading}]", commented_table(document.kind, heading))
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


def _add(menu: QMenu, document: TextDocument, words: str, text: str) -> None:
    menu.addAction(ui.action(menu, words, partial(document.append, text)))
