"""Reference of the public names from their signatures and docstrings; docs/conf.py puts it into reference/python.md."""

from __future__ import annotations

import inspect
import re
from typing import Any

import numpy as np

import wavefocus

FUNCTIONS = {
    "Banks": ("open_bank", "virtual_rig", "import_bank", "export_bank", "add_note"),
    "Scenes, drives and fields": ("load_scene", "render", "predict", "interpolate", "focus_figures", "quiet_levels"),
    "Live sources": ("live",),
    "Files": ("read_drive", "write_drive", "read_field", "write_field"),
    "Recordings": ("estimate", "open_raw", "estimator", "estimate_positions"),
}
CLASSES = {
    "Files and arrays": ("Bank", "GreenArray", "Drive", "Field", "FocusResults", "RawFile"),
    "Scenes": (
        "Scene", "Source", "QuietPlace", "Point", "Line", "Circle", "Polyline", "TrajectoryPath", "Impulse", "Sine",
        "Noise", "SoundFile",
    ),
    "Live sources": ("LiveSources",),
    "The virtual rig": ("VirtualBench",),
    "Errors": ("InputError",),
}  # fmt: skip
CALLED = {"GreenArray", "Drive", "Field", *CLASSES["Scenes"]}
"""Classes that people make themselves; the others come from functions."""
WIDTH = 88


def entries() -> str:
    """All functions and classes, as Markdown."""
    parts = [""]
    for title, names in FUNCTIONS.items():
        parts.append(f"## {title}\n")
        parts += [_function_entry(name) for name in names]
    for title, names in CLASSES.items():
        parts.append(f"## Classes: {title.lower()}\n")
        parts += [_class_entry(name) for name in names]
    return "\n".join(parts)


def _function_entry(name: str) -> str:
    """A function: signature, sentences, parameters, and an example."""
    function = getattr(wavefocus, name)
    return f"### `{name}`\n\n{code(signature(f'wf.{name}', function))}\n\n{markdown(function)}"


def _class_entry(name: str) -> str:
    """A class: what it holds, its properties as a list, and its methods."""
    kind = getattr(wavefocus, name)
    bases = (base for base in reversed(kind.__mro__) if base.__module__.startswith("wavefocus"))
    members = {key: member for base in bases for key, member in vars(base).items()}
    own = {key: member for key, member in members.items() if not key.startswith("_") and inspect.getdoc(member)}
    call = f"{code(signature(f'wf.{name}', kind))}\n\n" if name in CALLED else ""
    parts = [f"### `{name}`\n\n{call}{markdown(kind)}"]
    if values := {key: member for key, member in own.items() if isinstance(member, property)}:
        lines = (f"- `{key}`: {paragraph(_code_marks(inspect.getdoc(member)))}" for key, member in values.items())
        parts.append("\n".join(lines) + "\n")
    for key, member in own.items():
        if inspect.isroutine(member):
            parts.append(f"#### `{name}.{key}`\n\n{code(signature(key, member))}\n\n{markdown(member)}")
    return "\n".join(parts)


class _Bare:
    """Something that stands in a signature as this text."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text


def _annotated(annotation: Any) -> str:
    """An annotation as it is written: names without their modules, arrays by their type."""
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    text = re.sub(r"\b(?:\w+\.)+(?=\w)", "", text)
    return re.sub(r"ndarray\[tuple\[Any, \.\.\.\], dtype\[(\w+)\]\]", r"NDArray[\1]", text)


def signature(name: str, function: Any) -> str:
    """A call with the types of its parameters, a line for each where it is long."""
    found = inspect.signature(function)
    parameters = [_bare(parameter) for parameter in found.parameters.values() if parameter.name != "self"]
    result = "" if found.return_annotation is found.empty else f" -> {_annotated(found.return_annotation)}"
    call = found.replace(parameters=parameters, return_annotation=found.empty)
    if len(line := f"{name}{call}{result}") <= WIDTH:
        return line
    lines = [str(parameter) for parameter in parameters]
    if (keys := [parameter.kind is parameter.KEYWORD_ONLY for parameter in parameters]) and any(keys):
        lines.insert(keys.index(True), "*")
    return "\n".join([f"{name}(", *(f"    {line}," for line in lines), f"){result}"])


def _bare(parameter: inspect.Parameter) -> inspect.Parameter:
    annotation, default = parameter.annotation, parameter.default
    if annotation is not parameter.empty:
        parameter = parameter.replace(annotation=_Bare(_annotated(annotation)))
    if default is not parameter.empty and callable(default):
        parameter = parameter.replace(default=_Bare("np.float32" if default is np.float32 else "..."))
    return parameter


def code(text: str) -> str:
    """Python as a block."""
    return f"```python\n{text}\n```"


def _code_marks(text: str | None) -> str:
    """Literals and references of a docstring as Markdown's."""
    return re.sub(r"``([^`]+)``", r"`\1`", (text or "").replace(":func:", ""))


def markdown(thing: object) -> str:
    """A docstring as Markdown: sections in bold, what they name as a list, examples as code."""
    first, *sections = re.split(r"^(\w+)\n-+\n", _code_marks(inspect.getdoc(thing)), flags=re.MULTILINE)
    parts = [listed(first)]
    for title, body in zip(sections[::2], sections[1::2], strict=True):
        if title == "Examples":
            parts.append(f"```pycon\n{body.strip()}\n```\n")
        else:
            entries = re.findall(r"^(\S.*)\n((?:[ \t]+.*\n?|\n)+)", body, flags=re.MULTILINE)
            parts.append(f"**{title}**\n")
            parts.append("\n".join(f"- `{name}`: {paragraph(text)}" for name, text in entries) + "\n")
    return "\n".join(parts)


def listed(text: str) -> str:
    """Paragraphs; one whose lines name a parameter each becomes a list."""
    first, *blocks = text.strip().split("\n\n")
    found = [first]
    for block in blocks:
        entries = re.split(r"\n(?! )", block)
        if all(re.match(r"[a-z]\w*(, [^:]+)?: ", entry) for entry in entries):
            found.append("\n".join(re.sub(r"^([^:]+): ", r"- `\1`: ", paragraph(entry)) for entry in entries))
        else:
            found.append(block)
    return "\n\n".join(found) + "\n"


def paragraph(text: str) -> str:
    """Lines joined to one."""
    return " ".join(text.split())
