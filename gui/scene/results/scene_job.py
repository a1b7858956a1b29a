"""A scene handed to the command line: written as it is, rendered exactly, made into a file."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from gui.process.command_process import CommandProcess
from gui.scene.document import SceneDocument
from gui.scene.draft import scene_toml
from gui.shell.tab import TabContext

CANCELLED = -1
_DRIVE, _FIELD = "drive.h5", "field.h5"


class SceneJob:
    """Runs commands about a scene one after the other, in a folder of its own that goes with it.

    Parameters
    ----------
    context : TabContext
        Starts commands.
    document : SceneDocument
        The scene, as it is now; later edits do not matter.
    rig : str
        A rig file, or ``virtual``; empty for none.
    told : callable
        Told in words what is being done.

    Raises
    ------
    OSError
        There is no room for the folder.
    """

    def __init__(self, context: TabContext, document: SceneDocument, rig: str, told: Callable[[str], object]) -> None:
        self._context, self._told = context, told
        self._folder = tempfile.TemporaryDirectory(prefix="wavefocus-scene-", ignore_cleanup_errors=True)
        self._named = document.path.name if document.path else "the scene"
        self._bank = str(document.bank)
        self._rig = [*(["--rig", rig] if rig else []), *(["--allow-large"] if document.allow_large else [])]
        self._process: CommandProcess | None = None
        self._cancelled = False
        if document.path is not None and document.saved:
            self.scene_file = document.path
        else:
            self.scene_file = Path(self._folder.name) / "scene.toml"
            self.scene_file.write_text(scene_toml(document.draft), encoding="utf-8")

    @property
    def drive_file(self) -> Path:
        """The drive, where no other file was asked for."""
        return Path(self._folder.name) / _DRIVE

    @property
    def field_file(self) -> Path:
        """The predicted field."""
        return Path(self._folder.name) / _FIELD

    # Files of the job's own folder, and files whose replacement was confirmed in the dialog, are replaced.

    def render(self, out: Path | None = None, wav: Path | None = None) -> list[str]:
        """The command that renders the scene."""
        sound = [] if wav is None else ["--wav", str(wav)]
        into = str(out or self.drive_file)
        return ["render", str(self.scene_file), "--bank", self._bank, "--out", into, *sound, *self._rig, "--force"]

    def predict(self, rate_hz: float | None) -> list[str]:
        """The command that predicts the field of the drive, at a lower rate where one is given."""
        rate = [] if rate_hz is None else ["--rate", repr(rate_hz)]
        return ["predict", str(self.drive_file), "--bank", self._bank, "--out", str(self.field_file), *rate, "--force"]

    def movie(self, out: Path) -> list[str]:
        """The command that draws the field."""
        files = [str(self.field_file), "--bank", self._bank, "--drive", str(self.drive_file)]
        return ["movie", *files, "--out", str(out), "--force"]

    def run(self, commands: Sequence[tuple[str, Sequence[str]]], done: Callable[[int, str], object]) -> None:
        """Run commands, each with words for it, as long as they succeed; `done` gets the last code and sentence."""
        (words, arguments), rest = commands[0], commands[1:]

        def finished(process: CommandProcess) -> None:
            self._process = None
            if self._cancelled:
                done(CANCELLED, "")
            elif process.exit_code != 0 or not rest:
                done(process.exit_code or 0, self._plain(process.last_line))
            else:
                self.run(rest, done)

        self._told(words)
        self._process = self._context.run(arguments, finished)

    def cancel(self) -> None:
        """End what runs; files are left as they were."""
        self._cancelled = True
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """Take the folder away."""
        self._folder.cleanup()

    def _plain(self, sentence: str) -> str:
        """A sentence without the names of files that only this job knows."""
        plain = sentence.replace(str(Path(self._folder.name) / "scene.toml"), self._named)
        return plain.replace(str(self.drive_file), "the drive").replace(str(self.field_file), "the field")
