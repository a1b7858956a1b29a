"""Files that somebody chooses, in a dialog that holds up nothing, or drops on the window."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from PyQt5.QtCore import Qt, QUrl
from PyQt5.QtGui import QDropEvent
from PyQt5.QtWidgets import QFileDialog, QWidget

Chosen = Callable[[Path], None]


def make_dialog(owner: QWidget, title: str, folder: Path, kind: str, endings: Sequence[str]) -> QFileDialog:
    """Make a dialog that is still to be told what it is for, and to be shown.

    Parameters
    ----------
    owner : QWidget
        It lies above this one, and lives no longer.
    title : str
        Of the dialog.
    folder : Path
        Where it begins.
    kind : str
        What the files are called.
    endings : sequence of str
        Of such files, ``".h5"``.
    """
    dialog = QFileDialog(owner, title, str(folder), f"{kind} ({' '.join(f'*{ending}' for ending in endings)})")
    dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    dialog.setModal(False)
    return dialog


def choose_file(owner: QWidget, title: str, folder: Path, kind: str, endings: Sequence[str], chosen: Chosen) -> None:
    """Let somebody choose a file that is there; `chosen` gets it."""
    dialog = make_dialog(owner, title, folder, kind, endings)
    dialog.setFileMode(QFileDialog.FileMode.ExistingFile)
    _show(dialog, chosen)


def choose_place(owner: QWidget, title: str, suggested: Path, kind: str, ending: str, chosen: Chosen) -> None:
    """Let somebody choose a file to save to; `chosen` gets it."""
    dialog = make_dialog(owner, title, suggested.parent, kind, [ending])
    dialog.setAcceptMode(QFileDialog.AcceptMode.AcceptSave)
    dialog.setDefaultSuffix(ending.lstrip("."))
    dialog.selectFile(suggested.name)
    _show(dialog, chosen)


def dropped_files(event: QDropEvent) -> list[Path]:
    """Files of this machine in a drop."""
    content = event.mimeData()
    urls: list[QUrl] = [] if content is None else content.urls()
    return [Path(url.toLocalFile()) for url in urls if url.isLocalFile()]


def _show(dialog: QFileDialog, chosen: Chosen) -> None:
    dialog.fileSelected.connect(lambda name: chosen(Path(name)))
    dialog.show()
