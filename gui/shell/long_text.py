"""A text of many lines in a window of its own, which holds up nothing."""

from __future__ import annotations

from PyQt5.QtCore import Qt
from PyQt5.QtGui import QFontDatabase
from PyQt5.QtWidgets import QDialog, QPlainTextEdit, QVBoxLayout, QWidget

_COLUMNS, _LINES = 110, 24


def show_text(title: str, text: str, owner: QWidget) -> QDialog:
    """Show a text with letters of one width, to be read and copied."""
    dialog = QDialog(owner)
    dialog.setWindowTitle(title)
    dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    shown = QPlainTextEdit(text)
    shown.setReadOnly(True)
    shown.setAccessibleName(title)
    shown.setLineWrapMode(QPlainTextEdit.LineWrapMode.NoWrap)
    shown.setFont(QFontDatabase.systemFont(QFontDatabase.SystemFont.FixedFont))
    column = QVBoxLayout(dialog)
    column.addWidget(shown)
    metrics = shown.fontMetrics()
    dialog.resize(_COLUMNS * metrics.horizontalAdvance("0"), _LINES * metrics.lineSpacing())
    dialog.show()
    return dialog
