"""The menu that inserts a commented table of each kind into a text."""

from functools import partial

from PyQt5.QtWidgets import QMenu, QToolButton

from wavefocus.config.editing import commented_table, example
from wavefocus.config.fields import tables_of
from wavefocus.config.scene import PathTable, PointTable, SceneConfig, SignalTable, tables_by_kind
from wavefocus.gui import widgets as ui
from wavefocus.gui.editor.document import TextDocument
from wavefocus.gui.scene.draft import changed, new_source


def insert_button(document: TextDocument) -> QToolButton:
    """A button with a menu of the tables that a document's file can have."""
    button = ui.tool_button("Insert", "Insert a table with a comment for each of its keys")
    button.setPopupMode(QToolButton.ToolButtonPopupMode.InstantPopup)
    button.setMenu(insert_menu(document))
    return button


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
