"""A draft as a scene file, and the tables of a scene file as a draft."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from gui.scene.draft import (
    PATHS,
    SIGNALS,
    FileDraft,
    OutputDraft,
    PathDraft,
    RegularisationDraft,
    SceneDraft,
    SignalDraft,
    SourceDraft,
    SvgDraft,
)

_PATH_BY_KIND = {kind.kind: kind for kind in PATHS}
_SIGNAL_BY_KIND = {kind.kind: kind for kind in SIGNALS}


def scene_toml(draft: SceneDraft, folder: Path | None = None) -> str:
    """Write a draft as a scene file.

    Parameters
    ----------
    draft : SceneDraft
        The scene; nothing about it is checked here.
    folder : Path, optional
        Where the file will lie: files inside it are named relative to it, others in full.

    Returns
    -------
    str
        TOML, as contract section 4 says.
    """
    tables = [_table("[scene]", {"name": draft.name})]
    tables += [source_toml(source, folder) for source in draft.sources]
    held = draft.regularisation
    regularisation: dict[str, object] = {"saturation": held.saturation}
    if held.saturation_absolute:
        regularisation["saturation_absolute"] = held.saturation_absolute
    regularisation["normalise"] = held.normalise
    tables.append(_table("[regularisation]", regularisation))
    output = draft.output
    limits = {"limit_v": output.limit_v, "limit_rms_v": output.limit_rms_v}
    tables.append(_table("[output]", {"interpolation": output.interpolation, **_known(limits)}))
    return "\n".join(tables)


def source_toml(source: SourceDraft, folder: Path | None = None) -> str:
    """Write one source as its `[[source]]` table."""
    path, signal = source.path, source.signal
    if isinstance(path, SvgDraft):
        path = replace(path, file=_as_named(path.file, folder))
    if isinstance(signal, FileDraft):
        signal = replace(signal, path=_as_named(signal.path, folder))
    moves = {"speed_mm_s": source.speed_mm_s, "step_mm": source.step_mm}
    return _table(
        "[[source]]",
        {
            "start_s": source.start_s,
            **_known(moves),
            "amplitude": source.amplitude,
            "path": _keys(path),
            "signal": _keys(signal),
            "emission": source.emission,
        },
    )


def draft_of(tables: Mapping[str, Any], folder: Path) -> SceneDraft:
    """Make a draft of the tables of a scene file that are valid and have all their defaults.

    Parameters
    ----------
    tables : mapping
        As `FrontDoor.read_scene_tables` gives them.
    folder : Path
        What file names in them are relative to.
    """
    return SceneDraft(
        name=tables["scene"]["name"],
        sources=tuple(_source_of(one, folder) for one in tables["source"]),
        regularisation=RegularisationDraft(**tables["regularisation"]),
        output=OutputDraft(**tables["output"]),
    )


def _source_of(table: Mapping[str, Any], folder: Path) -> SourceDraft:
    path = _of_kind(_PATH_BY_KIND, table["path"])
    signal = _of_kind(_SIGNAL_BY_KIND, table["signal"])
    if isinstance(path, SvgDraft):
        path = replace(path, file=str(folder / path.file))
    if isinstance(signal, FileDraft):
        signal = replace(signal, path=str(folder / signal.path))
    return SourceDraft(**{**table, "path": path, "signal": signal})


def _of_kind(kinds: Mapping[str, type[Any]], table: Mapping[str, Any]) -> Any:
    return kinds[table["kind"]](**{key: value for key, value in table.items() if key != "kind"})


def _as_named(file: str, folder: Path | None) -> str:
    """A file as the scene in a folder names it: what is in the folder moves with it."""
    start = f"{folder}/"
    if folder is not None and file.startswith(start):
        return file.removeprefix(start)
    return file


def _keys(part: PathDraft | SignalDraft) -> dict[str, object]:
    return {"kind": part.kind, **{one.name: getattr(part, one.name) for one in fields(part)}}


def _known(values: Mapping[str, float | None]) -> dict[str, float]:
    return {key: value for key, value in values.items() if value is not None}


def _table(heading: str, keys: Mapping[str, object]) -> str:
    return "\n".join([heading, *(f"{key} = {_value(value)}" for key, value in keys.items())]) + "\n"


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # What JSON escapes TOML escapes alike, but TOML wants the delete character escaped too.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        return f"[{', '.join(_value(entry) for entry in value)}]"
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{key} = {_value(entry)}' for key, entry in value.items())} }}"
    return repr(value)
