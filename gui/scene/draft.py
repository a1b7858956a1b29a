"""The scene being edited: tables of a scene file that may still be incomplete, and their TOML text."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from config.fields import Table
from config.loading import parse_toml, validated
from config.scene import (
    CircleTable,
    FileTable,
    ImpulseTable,
    LineTable,
    NoiseTable,
    Output,
    PathTable,
    PointTable,
    PolylineTable,
    SceneConfig,
    SignalTable,
    SineTable,
    SourceTable,
    SvgTable,
    TextTable,
)

PointMm = tuple[float, float]
AnyTable = TypeVar("AnyTable", bound=Table)

#: What a new path or signal is until it is edited, by kind.
NEW_PATHS: dict[str, PathTable] = {
    one.kind: one
    for one in (
        PointTable(at_mm=(0.0, 0.0)),
        LineTable(start_mm=(-30.0, 0.0), end_mm=(30.0, 0.0)),
        CircleTable(radius_mm=20.0),
        PolylineTable(points_mm=((-20.0, -10.0), (0.0, 20.0), (20.0, -10.0))),
        TextTable(string="text", height_mm=20.0),
        SvgTable.model_construct(file=""),
    )
}
NEW_SIGNALS: dict[str, SignalTable] = {
    one.kind: one
    for one in (
        ImpulseTable(),
        SineTable(frequency_hz=200.0, duration_s=0.1),
        NoiseTable(band_hz=(50.0, 450.0), duration_s=0.015, seed=1),
        FileTable.model_construct(path=""),
    )
}
_SPEED_MM_S, _STEP_MM = 80.0, 4.0
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
        source = SourceTable.model_construct(path=path, signal=NEW_SIGNALS["noise"], emission="per_point")
    else:
        source = changed(model, path=path)
    return source if path.kind == "point" else moving(source)


def moving(source: SourceTable) -> SourceTable:
    """Return the source with speed and step, where it has none."""
    return changed(source, speed_mm_s=source.speed_mm_s or _SPEED_MM_S, step_mm=source.step_mm or _STEP_MM)


def scene_toml(scene: SceneConfig, folder: Path | None = None) -> str:
    """Write a scene as a scene file.

    Parameters
    ----------
    scene : SceneConfig
        The scene; nothing about it is checked here.
    folder : Path, optional
        Folder of the file: files inside it are named relative to it, others in full.

    Returns
    -------
    str
        TOML, as contract section 4 says.
    """
    held = scene.regularisation
    return "\n".join(
        [
            _table("[scene]", scene.scene),
            *(source_toml(source, folder) for source in scene.source),
            _table("[regularisation]", held, {} if held.saturation_absolute else {"saturation_absolute": None}),
            _table("[output]", scene.output),
        ]
    )


def source_toml(source: SourceTable, folder: Path | None = None) -> str:
    """Write one source as its `[[source]]` table."""
    start = "" if folder is None else f"{folder}/"
    return _table("[[source]]", with_files(source, lambda file: file.removeprefix(start)))


def read_draft(text: str, path: Path) -> SceneConfig:
    """Read the text of a scene file, but not the files that it names.

    Parameters
    ----------
    text : str
        What the scene file holds.
    path : Path
        The scene file; names of files in the result are absolute.

    Raises
    ------
    InputError
        The text is no scene.
    """
    scene = validated(SceneConfig, parse_toml(text, str(path)), str(path))
    return changed(
        scene, source=tuple(with_files(source, lambda file: str(path.parent / file)) for source in scene.source)
    )


def with_files(source: SourceTable, rename: Callable[[str], str]) -> SourceTable:
    """Return the source with other names of the files that it has."""
    if isinstance(source.path, SvgTable):
        source = changed(source, path=changed(source.path, file=rename(source.path.file)))
    if isinstance(source.signal, FileTable):
        source = changed(source, signal=changed(source.signal, path=rename(source.signal.path)))
    return source


def _table(heading: str, table: Table, changes: dict[str, object] | None = None) -> str:
    values = {**dict(table), **(changes or {})}
    return (
        "\n".join([heading, *(f"{key} = {_value(value)}" for key, value in values.items() if value is not None)]) + "\n"
    )


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # TOML escapes as JSON does, and the delete character too.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        return f"[{', '.join(_value(entry) for entry in value)}]"
    if isinstance(value, Table):
        return f"{{ {', '.join(f'{key} = {_value(entry)}' for key, entry in value)} }}"
    return repr(value)
