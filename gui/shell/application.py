"""Makes the application and runs the window."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from pathlib import Path

from PyQt5.QtCore import Qt
from PyQt5.QtGui import QFontDatabase, QGuiApplication
from PyQt5.QtWidgets import QApplication

from gui.shell.front_door import FrontDoor
from gui.shell.settings import Settings
from gui.shell.theme import BoxStyle
from gui.shell.window import Window
from storage.errors import InputError

# Fontconfig's own names, which Qt lists even without fonts.
_NAMES_WITHOUT_FONTS = {"Monospace", "Sans Serif", "Serif"}


def make_application(arguments: Sequence[str] = ("wavefocus",)) -> QApplication:
    """Make the application, sharp at any scaling.

    Raises
    ------
    InputError
        The system has no font: Qt would show no text.
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

    Raises
    ------
    InputError
        There is none.
    """
    if not set(QFontDatabase().families()) - _NAMES_WITHOUT_FONTS:
        raise InputError(
            "the window would show no text, for the system has no font: install one, on Debian and Ubuntu: "
            "sudo apt-get install fonts-dejavu-core"
        )


def show(front: FrontDoor, files: Sequence[Path]) -> int:
    """Show the window until it is closed."""
    application = make_application()
    window = Window(front, Settings())
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
