"""The document of the Scene tab: the text of a scene file, the scene that it says, its points, its bank and rig."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from PyQt5.QtCore import QObject, pyqtSignal

from wavefocus.config import scene as config
from wavefocus.config.editing import lines_of, mistakes_in
from wavefocus.config.fields import Table, toml_table
from wavefocus.config.loading import parse_toml, validated
from wavefocus.gui.editor.document import TextDocument
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.rendering.scene.model import Scene

PointMm = tuple[float, float]
AnyTable = TypeVar("AnyTable", bound=Table)
FilesTable = TypeVar("FilesTable", config.SourceTable, config.QuietTable)


DECIMALS = 2  # of millimetres that are drawn
NEW_AMPLITUDE = 0.01
"""Amplitude of a new source, in the bank's response unit: 10 mm/s is felt, and a rig of this kind can play it."""
EMPTY = "the scene has no source yet: draw one on the surface, or write one"
# A drive that no actuator could play is of no use: new scenes keep to the limit of the scenes of `init`.
NEW_SCENE = config.SceneConfig.model_construct(source=(), output=config.Output(limit_v=1.0))


def changed(table: AnyTable, **changes: object) -> AnyTable:
    """Return a table with other values; they are checked when the scene is read."""
    return table.model_copy(update=changes)


def new_source(path: config.PathTable) -> config.SourceTable:
    """A source on a path, to be edited."""
    moves = path.kind not in config.WITHOUT_SPEED
    return config.SourceTable(
        path=path,
        signal=config.NoiseTable(band_hz=(50.0, 450.0), duration_s=0.015, seed=1),
        emission="continuous" if path.kind == "trajectory" else "per_point",
        amplitude=NEW_AMPLITUDE,
        speed_mm_s=80.0 if moves else None,
        step_mm=4.0 if moves else None,
    )


Keys = tuple[str | int, ...]


def handles(table: config.SourceTable | config.QuietTable) -> list[tuple[Keys, PointMm]]:
    """The points of a source or a quiet place that can be moved, with their keys beneath its table."""
    if isinstance(table, config.QuietTable) and table.at_mm is not None:
        return [(("at_mm",), table.at_mm)]
    match table.path:
        case config.PointTable(at_mm=at_mm):
            return [(("path", "at_mm"), at_mm)]
        case config.LineTable(start_mm=start_mm, end_mm=end_mm):
            return [(("path", "start_mm"), start_mm), (("path", "end_mm"), end_mm)]
        case config.CircleTable(centre_mm=(x_mm, y_mm), radius_mm=radius_mm):
            return [(("path", "centre_mm"), (x_mm, y_mm)), (("path", "radius_mm"), (x_mm + radius_mm, y_mm))]
        case config.PolylineTable(points_mm=points_mm):
            return [(("path", "points_mm", index), point) for index, point in enumerate(points_mm)]
        case config.TextTable(centre_mm=centre_mm):
            return [(("path", "centre_mm"), centre_mm)]
        case config.SvgTable(origin_mm=origin_mm):
            return [(("path", "origin_mm"), origin_mm)]
    return []


def with_handle(table: AnyTable, keys: Keys, at_mm: PointMm) -> AnyTable:
    """A source or a quiet place with one of its points elsewhere."""
    key, *rest = keys
    held = getattr(table, str(key))
    if isinstance(held, Table):
        return changed(table, **{str(key): with_handle(held, tuple(rest), at_mm)})
    if rest:
        points = list(held)
        points[int(rest[0])] = at_mm
        return changed(table, **{str(key): tuple(points)})
    if isinstance(table, config.CircleTable) and key == "radius_mm":
        return changed(table, radius_mm=round(math.dist(table.centre_mm, at_mm), DECIMALS))
    return changed(table, **{str(key): at_mm})


def moved(text: str, place: Keys, keys: Keys, table: config.SourceTable | config.QuietTable) -> str:
    """The text of a scene with the numbers of one point as a table has them; all else stays, comments too.

    place: The list and the index of the table in the scene.
    keys: Of the point, beneath the table.
    table: The table with the point moved.

    Raises InputError: The text cannot be changed in this way.
    """
    import tomlkit  # 0.1 s

    value: Any = table
    for key in keys:
        value = value[key] if isinstance(key, int) else getattr(value, key)
    try:
        document: Any = tomlkit.parse(text)
        held = document
        for key in (*place, *keys[:-1]):
            held = held[key]
        if isinstance(value, tuple) and keys[-1] in held and len(held[keys[-1]]) == len(value):
            for index, number in enumerate(value):
                held[keys[-1]][index] = number
        else:
            held[keys[-1]] = list(value) if isinstance(value, tuple) else value
        return str(tomlkit.dumps(document))
    except (tomlkit.exceptions.TOMLKitError, LookupError, TypeError) as failure:
        raise InputError(
            f"this point cannot be moved by the mouse ({failure}): change its numbers in the text"
        ) from None


def scene_toml(scene: config.SceneConfig) -> str:
    """Write a scene as a scene file, as docs/reference/scene-file.md says; nothing about it is checked here."""
    return "\n".join(
        [
            toml_table("[scene]", scene.scene),
            *(toml_table("[[source]]", source) for source in scene.source),
            *(toml_table("[[quiet]]", place) for place in scene.quiet),
            config.regularisation_toml(scene.regularisation),
            toml_table("[output]", scene.output),
        ]
    )


def with_absolute_files(scene: config.SceneConfig, folder: Path) -> config.SceneConfig:
    """The scene with full names of the files that it names relative to a folder."""

    def named(table: FilesTable) -> FilesTable:
        if isinstance(table.path, config.SvgTable | config.TrajectoryTable):
            table = changed(table, path=changed(table.path, file=str(folder / table.path.file)))
        if isinstance(table, config.SourceTable) and isinstance(table.signal, config.FileTable):
            table = changed(table, signal=changed(table.signal, path=str(folder / table.signal.path)))
        return table

    return changed(scene, source=tuple(map(named, scene.source)), quiet=tuple(map(named, scene.quiet)))


def build_draft(draft: config.SceneConfig, place: Path) -> Scene:
    """Build the scene that commands read from the draft's file.

    place: The scene file; it need not exist.

    Raises InputError: The scene is not finished, or a value or a file that it names is wrong; the message says which
        key, without the scene file's name.
    """
    if not draft.source:
        raise InputError(EMPTY)
    from wavefocus.rendering.scene.model import build_scene  # loads scipy, in a thread

    try:
        return build_scene(draft, place)
    except InputError as error:
        raise InputError(str(error).removeprefix(f"{place}: ")) from None


_ANY_SOURCE = toml_table("[[source]]", new_source(config.PointTable(at_mm=(0.0, 0.0))))
_SOURCE = re.compile(r"^\s*\[\[source\]\]", re.MULTILINE)
# Lists of tables that stand on the surface.
SOURCE, QUIET = "source", "quiet"
Chosen = tuple[str, int]
NOTHING: Chosen = ("", -1)


class SceneDocument(TextDocument):
    """The text of one scene file.

    draft: The scene that the text says; the last one that could be read.
    chosen: The list and the index of the source or quiet place in whose table the cursor is; `NOTHING` for none.
    bank, rig: Whose measurements and limits count; the rig as the command line takes it. None, and empty, for none.
    """

    #: Another source or quiet place is chosen.
    chosen_changed = pyqtSignal()
    #: Another bank, or none.
    bank_changed = pyqtSignal()
    #: Another rig, or none.
    rig_changed = pyqtSignal()

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__("scene", parent)
        self.draft, self.chosen = NEW_SCENE, NOTHING
        self.bank: Path | None = None
        self.rig = ""
        self.clear()

    @property
    def worth_keeping(self) -> bool:
        return bool(self.draft.source or self.path or (self.mistakes and self.toml().strip()))

    @property
    def problem(self) -> str:
        """Why the text is no scene; empty where it is one."""
        return self.mistakes[0].sentence if self.mistakes else ""

    @property
    def source(self) -> config.SourceTable | None:
        """The chosen source."""
        kind, index = self.chosen
        return self.draft.source[index] if kind == SOURCE and 0 <= index < len(self.draft.source) else None

    @property
    def table(self) -> config.SourceTable | config.QuietTable | None:
        """The chosen source or quiet place."""
        kind, index = self.chosen
        places = self.draft.quiet if kind == QUIET else ()
        return places[index] if 0 <= index < len(places) else self.source

    def append(self, text: str) -> None:
        super().append(text)
        places = self.draft.quiet if text.startswith(f"[[{QUIET}]]") else self.draft.source
        self.choose((QUIET if places is self.draft.quiet else SOURCE, len(places) - 1))

    def choose(self, chosen: Chosen) -> None:
        """Choose a source or a quiet place."""
        if chosen != self.chosen:
            self.chosen = chosen
            self.chosen_changed.emit()

    def choose_at_line(self, line: int) -> None:
        """Choose the source or quiet place in whose table a line of the text is."""
        before = {at: steps for steps, at in lines_of(self.toml()).items() if at <= line}
        steps = before[max(before)] if before else ()
        self.choose((str(steps[0]), int(steps[1])) if steps and steps[0] in (SOURCE, QUIET) else NOTHING)

    def use_bank(self, bank: Path | None) -> None:
        """Use the measurements of another bank, or none."""
        if bank != self.bank:
            self.bank = bank
            self.bank_changed.emit()

    def use_rig(self, rig: str) -> None:
        """Use another rig file, or ``virtual``, or none."""
        if rig != self.rig:
            self.rig = rig
            self.rig_changed.emit()

    def clear(self) -> None:
        self.begin(scene_toml(NEW_SCENE), None)

    def begin(self, text: str, path: Path | None) -> None:
        self.draft = NEW_SCENE
        super().begin(text, path)
        self.choose((SOURCE, 0) if self.draft.source else NOTHING)

    def save(self, path: Path) -> None:
        if not _SOURCE.search(self.toml()):
            raise InputError(f"{path}: not saved: {EMPTY}")
        super().save(path)

    def read(self) -> None:
        self._soon.stop()
        empty = not _SOURCE.search(self.toml())
        # A scene without a source is not finished, but not wrong.
        text = f"{self.toml()}\n{_ANY_SOURCE}" if empty else self.toml()
        self.mistakes = mistakes_in(text, self.model)
        if not self.mistakes:
            draft = validated(config.SceneConfig, parse_toml(text, str(self.place)), str(self.place))
            self.draft = changed(draft, source=()) if empty else draft
        self.changed.emit()
