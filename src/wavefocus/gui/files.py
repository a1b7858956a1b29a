"""Settings kept between sessions, file dialogs that do not block, a field for a path, and kinds of TOML files."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import Protocol

from PyQt5.QtCore import QByteArray, QMetaProperty, QSettings, Qt, pyqtSignal
from PyQt5.QtWidgets import QFileDialog, QLineEdit, QSplitter, QWidget

from wavefocus.config.loading import hdf5_kind, kind_of_tables, read_toml
from wavefocus.gui import widgets as ui
from wavefocus.gui.message_bar import MessageBar
from wavefocus.gui.surface import VIRTUAL, is_virtual
from wavefocus.rendering.verify.record import FIELD_NAMES, RECORD_NAME, REPORT_NAME
from wavefocus.storage.errors import InputError


class Settings:
    """Geometry, folders, recent files and choices, in the system's store; tests pass another one."""

    def __init__(self, settings: QSettings | None = None) -> None:
        self._settings = settings or QSettings("wavefocus", "wavefocus")

    def text(self, key: str, default: str = "") -> str:
        value = self._settings.value(key, default)
        return value if isinstance(value, str) else default

    def bytes(self, key: str) -> QByteArray:
        """A remembered geometry; empty when there is none."""
        value = self._settings.value(key)
        return value if isinstance(value, QByteArray) else QByteArray()

    @property
    def place(self) -> str:
        """Where settings are kept: a file, or a key of the registry."""
        return self._settings.fileName()

    def can_save(self) -> bool:
        """Return whether what is kept reaches the disk; a full disk or a folder without rights prevents it."""
        self._settings.sync()
        fresh = QSettings(self._settings.fileName(), self._settings.format())  # the status of the other one is of old
        fresh.setValue("checked", str(time.time()))
        fresh.sync()
        return fresh.status() == QSettings.Status.NoError

    def keep(self, key: str, value: str | int | QByteArray) -> None:
        self._settings.setValue(key, str(value) if isinstance(value, int) else value)

    def folder(self, kind: str, near: Path | None = None) -> Path:
        """The folder where a file of a kind was last chosen; at first that of the file it is made from, if any."""
        found = Path(self.text(f"folder/{kind}") or (near.parent if near is not None else "."))
        return found if found.is_dir() else Path.cwd()

    def recent(self) -> list[Path]:
        """Files opened last, the latest first."""
        return [Path(line) for line in self.text("recent").split("\n") if line]

    def opened(self, path: Path) -> None:
        """Remember that a file was opened, and where."""
        path = path.absolute()
        others = [one for one in self.recent() if one != path]
        self.keep("recent", "\n".join(str(one) for one in [path, *others][:10]))
        self.keep(f"folder/{path.suffix}", str(path.parent))

    def save(self, key: str, widget: QWidget) -> None:
        """Keep what a widget holds: a path, text, number, tick, or the sizes of a splitter's parts."""
        match widget:
            case PathField():
                self.keep(key, str(widget.path or ""))
            case QSplitter():
                self.keep(key, widget.saveState())
            case _:
                self.keep(key, str(_held(widget).read(widget)))

    def restore(self, key: str, widget: QWidget) -> None:
        """Show in a widget what `save` kept; it stays as it is where there is nothing."""
        match widget:
            case PathField():
                widget.show_path(Path(kept) if (kept := self.text(key)) else None)
            case QSplitter():
                direction = widget.orientation()
                widget.restoreState(self.bytes(key))
                widget.setOrientation(direction)  # the state of another version may have the other one
            case _ if kept := self.text(key):
                _held(widget).write(widget, kept)


def _held(widget: QWidget) -> QMetaProperty:
    """The property that a person changes: text, number or tick."""
    kind = widget.metaObject()
    assert kind is not None
    return kind.userProperty()


def make_dialog(owner: QWidget, title: str, folder: Path, kind: str, endings: Sequence[str]) -> QFileDialog:
    """Make a dialog for files with some endings, called `kind`, which does not block; the caller shows it."""
    dialog = QFileDialog(owner, title, str(folder), f"{kind} ({' '.join(f'*{ending}' for ending in endings)})")
    dialog.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    return dialog


def choose_place(
    owner: QWidget, title: str, suggested: Path, kinds: Mapping[str, str], chosen: Callable[[Path], None]
) -> None:
    """Call `chosen` with a file to save to; `kinds` has the kind of file of each ending, the usual one first."""
    endings = {f"{kind} (*{ending})": ending for ending, kind in kinds.items()}
    dialog = make_dialog(owner, title, suggested.parent, "", [])
    dialog.setAcceptMode(QFileDialog.AcceptMode.AcceptSave)
    dialog.setNameFilters(list(endings))

    def name(kind: str) -> None:
        dialog.setDefaultSuffix(endings[kind])
        dialog.selectFile(suggested.with_suffix(endings[kind]).name)

    name(next(iter(endings)))
    dialog.filterSelected.connect(name)
    dialog.fileSelected.connect(lambda name: chosen(Path(name)))
    dialog.show()


class _Context(Protocol):
    """What a field for a path needs of `wavefocus.gui.tab.TabContext`."""

    @property
    def settings(self) -> Settings: ...

    @property
    def messages(self) -> MessageBar: ...

    def report(self, topic: str, sentence: str) -> None: ...


class PathField(QWidget):
    """A line for a path, with a button that opens a dialog.

    word: Label, with an ampersand before its key; empty for none.
    ending, kind: Ending of the files, ``".h5"``, and their name; an empty ending for folders. Where the name is one
        of `FileKind`, a file of another kind is refused.
    context: Has the folder of the last choice, and the message that says that a file is refused.
    saves: Whether the file may not exist yet.
    words: Words allowed in place of a path.
    """

    chosen = pyqtSignal(object)

    def __init__(
        self,
        word: str,
        ending: str,
        kind: str,
        context: _Context,
        *,
        saves: bool = False,
        words: Collection[str] = (),
    ) -> None:
        super().__init__()
        self._wanted = next((one for one in FileKind if one == kind), None)
        self._words = words
        self._ending, self._kind, self._context, self._saves = ending, kind, context, saves
        self._last: Path | None = None
        self.line = QLineEdit()
        self.line.setAccessibleName(kind)
        self.line.setPlaceholderText(f"{kind}: type or choose")
        self.browse = ui.tool_button("…", f"Choose {kind}", self._open_dialog, f"Choose {kind}")
        label = ui.labelled(word, self.line)[:1] if word else ()
        ui.row(*label, (self.line, 1), self.browse, owner=self)
        self.line.editingFinished.connect(self._typed)

    @property
    def path(self) -> Path | None:
        """The path, None while the line is empty or holds a word."""
        text = self.line.text().strip()
        return Path(text).expanduser().absolute() if text and text not in self._words else None

    def show_path(self, path: Path | None) -> None:
        """Show a path, or none, without emitting `chosen`."""
        self._last = path
        self.line.setText("" if path is None else short_path(path))
        self.line.setToolTip(str(path or ""))
        self.line.setCursorPosition(len(self.line.text()))

    def _typed(self) -> None:
        path = self.path
        if path is None:
            self._last = None
        elif path != self._last:
            self._choose(path)

    def _open_dialog(self) -> None:
        """Choose a file in a dialog that does not block."""
        folder = self.path.parent if self.path else self._context.settings.folder(self._ending)
        dialog = make_dialog(self, f"Choose {self._kind}", folder, self._kind, [self._ending])
        if not self._ending:
            # One that does not exist yet can be typed.
            dialog.setFileMode(QFileDialog.FileMode.Directory)
            dialog.setOption(QFileDialog.Option.ShowDirsOnly)
        elif self._saves:
            # A bank that is there is gone on with, never overwritten: there is nothing to confirm.
            dialog.setAcceptMode(QFileDialog.AcceptMode.AcceptSave)
            dialog.setOption(QFileDialog.Option.DontConfirmOverwrite)
            dialog.setLabelText(QFileDialog.DialogLabel.Accept, "Choose")
            dialog.setDefaultSuffix(self._ending.lstrip("."))
        else:
            dialog.setFileMode(QFileDialog.FileMode.ExistingFile)
        dialog.fileSelected.connect(self._selected)
        dialog.show()

    def _selected(self, name: str) -> None:
        self._context.settings.keep(f"folder/{self._ending}", str(Path(name).parent))
        self._choose(Path(name))

    def _choose(self, path: Path) -> None:
        refusal = "" if self._wanted is None else misplaced(path, self._wanted)
        self._context.messages.dismiss_old()  # about the former file
        self._context.report("file", refusal)
        if refusal:
            self.show_path(self._last)
            return
        self.show_path(path)
        if self._ending:
            self._context.settings.opened(path)
        self.chosen.emit(path)


FileState = tuple[int, ...]


def file_state(path: Path) -> FileState | None:
    """What is another where a file has been written or replaced since; None where it cannot be asked for."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_mtime_ns, found.st_size


def short_path(path: Path) -> str:
    """A path as people write it: from their own folder, where it lies in it."""
    try:
        return str(Path("~") / path.relative_to(Path.home()))
    except (ValueError, RuntimeError):
        return str(path)


class FileKind(StrEnum):
    """What a file is for, in words."""

    RUN = "run file"
    RIG = "rig file"
    BANK = "bank file"
    SCENE = "scene file"
    TRIALS = "file of perception trials"
    CALIBRATION = "calibration file"
    FIELD = "field file"
    RECORDINGS = "file of recordings"
    VERIFICATION = "file of a verification"
    PATH = "drawing or trajectory"


#: Endings of files that the window opens.
ENDINGS = (".h5", ".toml", ".svg", ".csv", ".json")
_HDF5_ENDINGS = (".h5", ".hdf5")


def kind_of(path: Path) -> FileKind | None:
    """What a file is for, by its name, its tables or its format; None where nobody can say.

    A TOML file whose tables do not say is a run: the capture reports what is wrong with it.
    """
    name = path.name.lower()
    if record_of(path) is not None:
        return FileKind.VERIFICATION
    if name.endswith(_HDF5_ENDINGS):
        if name.endswith(".raw.h5"):
            return FileKind.RECORDINGS
        return FileKind.FIELD if hdf5_kind(path) == FileKind.FIELD else FileKind.BANK
    if name.endswith((".svg", ".csv")):
        return FileKind.PATH
    if not name.endswith(".toml"):
        return None
    try:
        return FileKind[(kind_of_tables(read_toml(path)) or "run").upper()]
    except InputError:
        return None


def record_of(path: Path) -> Path | None:
    """Return the record of the verification that a file or folder belongs to; None for any other file."""
    if path.is_dir():
        return path / RECORD_NAME if (path / RECORD_NAME).is_file() else None
    if path.suffix.lower() == ".json":  # it may have been renamed
        return path
    sidecar = path.with_name(RECORD_NAME)
    return sidecar if path.name in (*FIELD_NAMES, REPORT_NAME) and sidecar.is_file() else None


def misplaced(path: Path, wanted: FileKind) -> str:
    """Return the sentence that refuses a file of another kind than the wanted one; empty where it may be of it.

    A file that does not exist, or cannot be read, is reported by what reads it.
    """
    kind = kind_of(path)
    return "" if kind in (wanted, None) else f"{path}: this is a {kind}; a {wanted} is needed here"


def names_virtual_rig(rig: str | Path) -> bool:
    """Whether ``virtual``, or a rig file, is a virtual rig; a file that nobody can read opens no instruments either."""
    with suppress(InputError):
        return str(rig) == VIRTUAL or is_virtual(read_toml(Path(rig)))
    return True


def rig_of_run(run: Path) -> Path | None:
    """The rig file that a run file names, None where it names none or cannot be read; the capture reports that."""
    with suppress(InputError):
        named = read_toml(run).get("rig")
        return run.parent / named if isinstance(named, str) and named != VIRTUAL else None
    return None
