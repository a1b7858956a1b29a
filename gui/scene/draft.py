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
            regularisation_toml(scene.regularisation),
            toml_table("[output]", scene.output),
        ]
    )


def source_toml(source: SourceTable, folder: Path | None = None) -> str:
    """Write one source as its `[[source]]` table."""
    return toml_table("[[source]]", source if folder is None else _relative(source, folder))


def read_draft(text: str, path: Path) -> SceneConfig:
    """Read the text of a scene file, but not the files that it names.

    text: What the scene file holds.
    path: The scene file; names of files in the result are absolute.

    Raises InputError: The text is no scene.
    """
    scene = validated(SceneConfig, parse_toml(text, str(path)), str(path))
    return changed(
        scene, source=tuple(with_files(source, lambda file: str(path.parent / file)) for source in scene.source)
    )


def with_files(source: SourceTable, rename: Callable[[str], str]) -> SourceTable:
    """Return the source with other names of the files that it has."""
    if isinstance(source.path, SvgTable | TrajectoryTable):
        source = changed(source, path=changed(source.path, file=rename(source.path.file)))
    if isinstance(source.signal, FileTable):
        source = changed(source, signal=changed(source.signal, path=rename(source.signal.path)))
    return source


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
    named = changed(draft, source=tuple(_relative(source, place.parent) for source in draft.source))
    try:
        config = validated(SceneConfig, named.model_dump(exclude_none=True, warnings=False), str(place))
        return build_scene(config, place, allow_large=allow_large)
    except InputError as error:
        raise InputError(str(error).removeprefix(f"{place}: ")) from None


def _relative(source: SourceTable, folder: Path) -> SourceTable:
    """The source with the names that its files have in a scene file of that folder."""
    start = f"{folder}/"
    return with_files(source, lambda file: file.removeprefix(start))
