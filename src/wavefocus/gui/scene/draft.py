"""Drafts of scenes: perhaps incomplete, changed key by key, written as TOML, and built into the scene of commands."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from wavefocus.config.fields import Table, toml_table
from wavefocus.config.loading import parse_toml, validated
from wavefocus.config.scene import (
    FileTable,
    Output,
    PathTable,
    QuietTable,
    SceneConfig,
    SignalTable,
    SourceTable,
    SvgTable,
    TrajectoryTable,
    regularisation_toml,
    tables_by_kind,
)
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.rendering.scene.model import Scene


PointMm = tuple[float, float]
AnyTable = TypeVar("AnyTable", bound=Table)
FilesTable = TypeVar("FilesTable", SourceTable, QuietTable)


def _new(table: Any) -> Any:
    """A table with the examples of its fields; they are not checked, for a file's name is still to be chosen."""
    return table.model_construct(
        **{key: field.examples[0] for key, field in table.model_fields.items() if field.examples}
    )


#: What a new path or signal is until it is edited, by kind.
NEW_PATHS: dict[str, PathTable] = {kind: _new(table) for kind, table in tables_by_kind(PathTable).items()}
NEW_SIGNALS: dict[str, SignalTable] = {kind: _new(table) for kind, table in tables_by_kind(SignalTable).items()}
_SPEED_MM_S, _STEP_MM = 80.0, 4.0
NEW_AMPLITUDE = 0.01
"""Amplitude of a new source, in the bank's response unit: 10 mm/s is felt, and a rig of this kind can play it."""
EMPTY = "the scene has no source yet: choose a tool and draw one on the surface"
# A drive that no actuator could play is of no use: new scenes keep to the limit of the scenes of `init`.
NEW_SCENE = SceneConfig.model_construct(source=(), output=Output(limit_v=1.0))


def changed(table: AnyTable, **changes: object) -> AnyTable:
    """Return a table with other values; they are checked when the scene is read."""
    return table.model_copy(update=changes)


def with_source(scene: SceneConfig, index: int, source: SourceTable) -> SceneConfig:
    """Return the scene with another source in one place."""
    return changed(scene, source=(*scene.source[:index], source, *scene.source[index + 1 :]))


def new_source(path: PathTable, model: SourceTable | None = None) -> SourceTable:
    """Return a source on a path; all else is as in `model`."""
    if model is None:
        source = SourceTable.model_construct(
            path=path, signal=NEW_SIGNALS["noise"], emission="per_point", amplitude=NEW_AMPLITUDE
        )
    else:
        source = changed(model, path=path)
    if path.kind == "point":
        return changed(source, repeat=False)
    return changed(source, emission="continuous") if path.kind == "trajectory" else moving(source)


def moving(source: SourceTable) -> SourceTable:
    """Return the source with speed and step, where it has none."""
    return changed(source, speed_mm_s=source.speed_mm_s or _SPEED_MM_S, step_mm=source.step_mm or _STEP_MM)


def scene_toml(scene: SceneConfig, folder: Path | None = None) -> str:
    """Write a scene as a scene file.

    scene: The scene; nothing about it is checked here.
    folder: Folder of the file: files inside it are named relative to it, others in full.

    Returns TOML, as contract section 4 says.
    """
    return "\n".join(
        [
            toml_table("[scene]", scene.scene),
            *(source_toml(source, folder) for source in scene.source),
            *(quiet_toml(place, folder) for place in scene.quiet),
            regularisation_toml(scene.regularisation),
            toml_table("[output]", scene.output),
        ]
    )


def source_toml(source: SourceTable, folder: Path | None = None) -> str:
    """Write one source as its `[[source]]` table."""
    return toml_table("[[source]]", source if folder is None else _relative(source, folder))


def quiet_toml(place: QuietTable, folder: Path | None = None) -> str:
    """Write one quiet place as its `[[quiet]]` table."""
    return toml_table("[[quiet]]", place if folder is None else _relative(place, folder))


def read_draft(text: str, path: Path) -> SceneConfig:
    """Read the text of a scene file, but not the files that it names.

    text: What the scene file holds.
    path: The scene file; names of files in the result are absolute.

    Raises InputError: The text is no scene.
    """
    scene = validated(SceneConfig, parse_toml(text, str(path)), str(path))
    return _with_all_files(scene, lambda file: str(path.parent / file))


def with_files(table: FilesTable, rename: Callable[[str], str]) -> FilesTable:
    """Return a source or a quiet place with other names of the files that it has."""
    if isinstance(table.path, SvgTable | TrajectoryTable):
        table = changed(table, path=changed(table.path, file=rename(table.path.file)))
    if isinstance(table, SourceTable) and isinstance(table.signal, FileTable):
        table = changed(table, signal=changed(table.signal, path=rename(table.signal.path)))
    return table


def _with_all_files(scene: SceneConfig, rename: Callable[[str], str]) -> SceneConfig:
    """The scene with other names of all files."""
    return changed(
        scene,
        source=tuple(with_files(one, rename) for one in scene.source),
        quiet=tuple(with_files(one, rename) for one in scene.quiet),
    )


def build_draft(draft: SceneConfig, place: Path, *, allow_large: bool = False) -> Scene:
    """Build the scene that commands read from the draft's file.

    draft: The draft; names of files in it are absolute.
    place: The scene file; it need not exist.

    Raises InputError: The scene is not finished, or a value or a file that it names is wrong; the message says which
        key, without the scene file's name.
    """
    from wavefocus.rendering.scene.model import build_scene  # loads scipy, in a thread

    if not draft.source:
        raise InputError(EMPTY)
    named = _with_all_files(draft, lambda file: file.removeprefix(f"{place.parent}/"))
    try:
        config = validated(SceneConfig, named.model_dump(exclude_none=True, warnings=False), str(place))
        return build_scene(config, place, allow_large=allow_large)
    except InputError as error:
        raise InputError(str(error).removeprefix(f"{place}: ")) from None


def _relative(table: FilesTable, folder: Path) -> FilesTable:
    """The table with the names that its files have in a scene file of that folder."""
    start = f"{folder}/"
    return with_files(table, lambda file: file.removeprefix(start))
