"""Saves what comes of a scene as a drive file, a WAV file or a movie, through the commands that make them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from PyQt5.QtCore import QObject, pyqtSignal

from gui.scene.document import SceneDocument
from gui.scene.results.scene_job import CANCELLED, SceneJob
from gui.shell.error_hook import error_text
from gui.shell.tab import TabContext

DRIVE, WAV, MOVIE = "drive", "WAV", "movie"
ENDINGS = {DRIVE: ".h5", WAV: ".wav", MOVIE: ".gif"}


class Saving(QObject):
    """Saves one file at a time.

    Parameters
    ----------
    context : TabContext
        Starts commands and tells how they ended.
    document : SceneDocument
        The scene.
    parent : QObject
        Lives no longer than this.
    """

    changed = pyqtSignal()

    def __init__(self, context: TabContext, document: SceneDocument, parent: QObject) -> None:
        super().__init__(parent)
        self._context, self._document = context, document
        self._job: SceneJob | None = None
        self.words = ""

    @property
    def busy(self) -> bool:
        """Whether something is being saved."""
        return self._job is not None

    def suggested(self, kind: str) -> Path:
        """A file, named after the scene; a drive's says what it is, for banks end alike."""
        scene = self._document.path
        stem = scene.stem if scene is not None else "scene"
        name = f"{stem}-drive.h5" if kind == DRIVE else f"{stem}{ENDINGS[kind]}"
        return self._context.settings.folder(_folder_kind(kind), scene) / name

    def save(self, kind: str, path: Path, rig: str, rate_hz: float | None) -> None:
        """Save the scene as it is now.

        Parameters
        ----------
        kind : str
            `DRIVE`, `WAV` or `MOVIE`.
        path : Path
            The file; an older one is replaced.
        rig : str
            A rig file whose limits are kept to; empty for none.
        rate_hz : float or None
            Of the field that a movie is drawn from; None for that of the bank.
        """
        if self._job is not None:
            return
        try:
            job = SceneJob(self._context, self._document, rig, self._tell)
        except OSError as failure:
            self._context.messages.fault(f"{path.name} is not saved: {error_text(failure)}")
            return
        self._job = job
        if kind == DRIVE:
            commands = [(f"rendering {path.name}", job.render(path))]
        elif kind == WAV:
            commands = [(f"rendering {path.name}", job.render(wav=path))]
        else:
            commands = [
                ("rendering the drives", job.render()),
                ("predicting the field", job.predict(rate_hz)),
                (f"drawing {path.name}", job.movie(path)),
            ]
        job.run(commands, self._ended(kind, path))

    def cancel(self) -> None:
        """Give up what is being saved."""
        if self._job is not None:
            self._job.cancel()

    def close(self) -> None:
        """The window closes: give up, and leave nothing lying about."""
        job, self._job = self._job, None
        if job is not None:
            job.cancel()
            job.close()

    def _ended(self, kind: str, path: Path) -> Callable[[int, str], None]:
        def ended(code: int, sentence: str) -> None:
            if self._job is None:  # the window closes
                return
            self._job.close()
            self._job, self.words = None, ""
            messages = self._context.messages
            if code == 0:
                self._context.settings.keep(f"folder/{_folder_kind(kind)}", str(path.parent))
                messages.note(f"{path} is saved: {sentence}" if sentence else f"{path} is saved")
            elif code == CANCELLED and not sentence:
                messages.note(f"{path.name} is not saved: you cancelled it")
            else:
                messages.fault(f"{path.name} is not saved: {sentence or 'its command ended without a word'}")
            self.changed.emit()

        return ended

    def _tell(self, words: str) -> None:
        self.words = words
        self.changed.emit()


def _folder_kind(kind: str) -> str:
    """What the folder of such files is remembered as: a drive is not a bank, whatever its ending."""
    return f"scene {kind}"
