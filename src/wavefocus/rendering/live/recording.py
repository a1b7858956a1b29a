"""The record of a live session: a scene that renders to the drives that were played, written while it goes on."""

from __future__ import annotations

import os
import queue
import re
import threading
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from wavefocus.config.fields import toml_table
from wavefocus.config.loading import printable
from wavefocus.config.scene import (
    FileTable,
    Output,
    Regularisation,
    SceneTable,
    SignalTable,
    SourceTable,
    TrajectoryTable,
    regularisation_toml,
    tables_by_kind,
)
from wavefocus.rendering.live.engine import RecordedLife
from wavefocus.rendering.scene.signals import SIGNALS, Signal
from wavefocus.rendering.scene.trajectory import Trajectory
from wavefocus.storage import durable
from wavefocus.storage.durable import Closing
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import replacement, write_whole

SCENE_NAME = "scene.toml"
_FILES = re.compile(r"scene(-([2-9]|[1-9]\d+))?\.toml|source-(0|[1-9]\d*)\.csv|signal-(0|[1-9]\d*)\.wav")


class SessionRecording(Closing):
    """Writes ``scene.toml`` and a trajectory for each life of a source into a folder, from a thread of its own.

    A life is one ``[[source]]``, with the file ``source-N.csv`` of its knots. Both only grow: what a killed session
    leaves is a scene up to then. Sound files and signals of other kinds are kept as WAV files of float64 at the bank's
    rate. The session's limits are no part of it: the scene renders to the drives before the limiter.

    folder: Made where missing; it must not hold files of a record, which would be written over.
    rate_hz: The bank's.

    Raises InputError: the folder holds files of a record, or cannot be written.
    """

    def __init__(self, folder: Path, *, rate_hz: float, regularisation: Regularisation, interpolation: str) -> None:
        self._folder, self._rate_hz = folder, rate_hz
        self._head = "\n".join(
            [
                "# Recorded by wavefocus live\n",
                toml_table("[scene]", SceneTable(name="live")),
                regularisation_toml(regularisation),
                toml_table("[output]", Output(interpolation=interpolation)),
            ]
        )
        try:
            folder.mkdir(parents=True, exist_ok=True)
            names = sorted(path.name.lower() for path in folder.iterdir())  # file systems may not tell cases apart
        except OSError as error:
            raise InputError(f"{folder}: cannot be made: {error.strerror or error}") from error
        for name in filter(_FILES.fullmatch, names):
            if os.path.lexists(folder / name):
                raise InputError(f"{folder / name} exists; name a new folder for the record")
        self._lives: dict[int, _Written] = {}
        self._named = 0
        self._waiting: queue.SimpleQueue[tuple[RecordedLife, ...] | None] = queue.SimpleQueue()
        self.failure = ""
        """Why nothing more is written; empty while all is well."""
        self._writer = threading.Thread(target=self._write, name="recording", daemon=True)
        self._writer.start()

    def add(self, lives: Iterable[RecordedLife]) -> None:
        """Take what `LiveEngine.take_record` gave; a few times a second is often enough. Never waits or raises."""
        if lives := tuple(lives):
            self._waiting.put(lives)

    @property
    def scene(self) -> Path | None:
        """The scene file; None where nothing has sounded yet, or nothing could be written."""
        return self._folder / SCENE_NAME if self._named else None

    def close(self) -> None:
        """Write what waits."""
        self._waiting.put(None)
        self._writer.join()

    def _write(self) -> None:
        while (lives := self._waiting.get()) is not None:
            if self.failure:
                continue
            try:
                for life in lives:
                    self._append(life)
            except OSError as error:
                self.failure = f"{self._folder}: cannot be written: {error.strerror or error}"
            except InputError as error:
                self.failure = str(error)

    def _append(self, life: RecordedLife) -> None:
        file = self._folder / f"source-{life.number}.csv"
        written = self._lives.get(life.number)
        if written is None:
            written = self._lives[life.number] = _Written(int(life.knots.sample[0]))
        written.waiting += _rows(life.knots, written.first_sample, self._rate_hz)
        written.rows += len(life.knots.sample)
        if written.rows < 2:  # a trajectory has two rows or more
            return
        with file.open("a", encoding="utf-8", newline="\n") as table:
            table.write(written.waiting)
        written.waiting = ""
        if not written.named:
            self._name(life, written, file)
        if life.over:
            durable.sync_path(file)
            del self._lives[life.number]

    def _name(self, life: RecordedLife, written: _Written, file: Path) -> None:
        """Add a life to the scene file."""
        signal, amplitude = self._signal(life)
        source = SourceTable(
            start_s=written.first_sample / self._rate_hz, amplitude=amplitude, path=TrajectoryTable(file=file.name),
            signal=signal, repeat=life.repeat,
        )  # fmt: skip
        text = f"\n# {printable(life.name)}\n{toml_table('[[source]]', source)}"
        # Sources of one scene file; further lives go into ``scene-2.toml`` and so on, whose drives add to those of the
        # first. A thousand take about half a minute of processor time to render, 20 actuators and 2000 taps.
        part, number = divmod(self._named, 10_000)
        scene = self._folder / (SCENE_NAME if not part else f"scene-{part + 1}.toml")
        if number:
            with scene.open("a", encoding="utf-8", newline="\n") as file_of_scene:
                file_of_scene.write(text)
        else:
            write_whole(scene, self._head + text)
        self._named, written.named = self._named + 1, True

    def _signal(self, life: RecordedLife) -> tuple[SignalTable, float]:
        """The table of a signal, and the amplitude that goes with it."""
        signal = life.signal
        kind = next((kind for kind, made in SIGNALS.items() if made is type(signal)), "file")
        if kind == "file":
            return self._sound(signal, self._folder / f"signal-{life.number}.wav")
        keys = {key: getattr(signal, key) for key in tables_by_kind(SignalTable)[kind].model_fields if key != "kind"}
        return tables_by_kind(SignalTable)[kind](**keys), 1.0

    def _sound(self, signal: Signal, file: Path) -> tuple[SignalTable, float]:
        import soundfile  # loaded where a sound was used

        from wavefocus.storage.exchange.wav import sound_failures  # with it comes all that reads banks of others

        rate_hz, samples = round(self._rate_hz), signal.samples(self._rate_hz)
        if rate_hz != self._rate_hz:
            raise InputError(
                f"{file}: not written: the bank's rate is {self._rate_hz:g} Hz, and a sound file needs a whole number"
            )
        with replacement(file) as temporary, sound_failures(file):
            soundfile.write(temporary, samples, rate_hz, format="WAV", subtype="DOUBLE")
        return FileTable(path=file.name), float(np.abs(samples).max())


class _Written:
    """A life that goes on, as far as it is on disk."""

    def __init__(self, first_sample: int) -> None:
        self.first_sample = first_sample
        self.waiting = "time_s,x_mm,y_mm,amplitude\n"
        self.rows = 0
        self.named = False


def _rows(knots: Trajectory, first_sample: int, rate_hz: float) -> str:
    """Lines of a trajectory's file; the time of each, from the first knot of the life, gives back its sample."""
    time_s = (knots.sample - first_sample) / rate_hz
    columns = zip(time_s.tolist(), *knots.at_mm.T.tolist(), knots.amplitude.tolist(), strict=True)
    return "".join(f"{','.join(map(repr, row))}\n" for row in columns)
