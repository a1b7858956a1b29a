"""A configuration file's text while it is edited: mistakes by line, keys that fit, help, and tables to insert."""

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from wavefocus.config.fields import Table, choices_of, explanation, fields_of, tables_of, toml_value, with_explanations
from wavefocus.config.loading import mistakes, parse_toml
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import RunConfig
from wavefocus.config.scene import SceneConfig
from wavefocus.storage.errors import InputError

MODELS: dict[str, type[Table]] = {"scene": SceneConfig, "run": RunConfig, "rig": RigConfig}
"""Tables of the files that can be edited, by kind."""
Steps = tuple[int | str, ...]
_HEADING = re.compile(r"\s*(\[\[?)\s*([\w.-]+)\s*\]")
_HEADINGS = re.compile(r"^[ \t]*\[\[?[ \t]*([\w.-]+)[ \t]*\]", re.MULTILINE)
_KEY = re.compile(r"\s*([\w-]+)\s*=")
_INLINE = re.compile(r"([\w-]+)\s*=\s*\{([^{}]*)$")
_LINE = re.compile(r"line (\d+)")


@dataclass(frozen=True, slots=True)
class Mistake:
    """A mistake at a line of the text, from 0."""

    line: int
    sentence: str


def mistakes_in(text: str, model: type[Table]) -> list[Mistake]:
    """The mistakes of a file's text, in the words of the command line, by line."""
    try:
        data = parse_toml(text, "")
    except InputError as wrong:
        sentence = str(wrong).removeprefix(": ")
        line = _LINE.search(sentence)
        last = text.count("\n") if "end of document" in sentence else 0
        return [Mistake(int(line[1]) - 1 if line else last, sentence)]
    lines = lines_of(text)
    found = [Mistake(_line(lines, steps), sentence) for steps, sentence in mistakes(model, data)]
    return sorted(found, key=lambda one: one.line)


def lines_of(text: str) -> dict[Steps, int]:
    """The line of each table and of each key outside of inline tables, from 0."""
    found: dict[Steps, int] = {}
    counts: dict[str, int] = {}
    table: Steps = ()
    for number, line in enumerate(text.split("\n")):
        if heading := _HEADING.match(line):
            if heading[1] == "[[":
                counts[heading[2]] = counts.get(heading[2], -1) + 1
            table = _steps(heading[2], counts)
            found.setdefault(table, number)
        elif key := _KEY.match(line):
            found.setdefault((*table, key[1]), number)
    return found


def completions(text: str, position: int, model: type[Table]) -> tuple[str, list[str]]:
    """The part of a word before a place of the text, and what may stand there in its place."""
    line = text[:position].rpartition("\n")[2]
    if "#" in line:
        return "", []
    if heading := re.fullmatch(r"\s*(\[+[\w.]*)", line):
        return heading[1], [one for one in _headings(model) if one.startswith(heading[1].rstrip())]
    tables = _tables_at(text, position, model)
    part = re.split(r"[{,]", line)[-1] if _INLINE.search(line) else line
    if value := re.fullmatch(r"\s*([\w-]+)\s*=\s*(\"?[\w.-]*)", part):
        fields = [table.model_fields[value[1]] for table in tables if value[1] in table.model_fields]
        found = dict.fromkeys(choice for field in fields for choice in _values(field))
        return value[2], [one for one in found if one.startswith(value[2])]
    word = re.fullmatch(r"\s*([\w-]*)", part)
    if word is None:
        return "", []
    known = dict.fromkeys(key for table in tables for key in table.model_fields)
    return word[1], [f"{key} = " for key in known if key.startswith(word[1])]


def help_at(text: str, position: int, model: type[Table]) -> str:
    """What the key or the heading at a place of the text means; empty where there is neither."""
    start, end = text.rfind("\n", 0, position) + 1, text.find("\n", position)
    line = text[start : len(text) if end < 0 else end]
    if heading := _HEADING.match(line):
        return " ".join(filter(None, (table.__doc__ for table in tables_of(model, heading[2]))))
    word = next((one for one in re.finditer(r"[\w-]+", line) if one.start() <= position - start <= one.end()), None)
    if word is None:
        return ""
    for table in _tables_at(text, start + word.start(), model):
        if word[0] in table.model_fields:
            return f"{word[0]}: {explanation(word[0], table.model_fields[word[0]])}"
    return ""


def example(table: type[BaseModel]) -> BaseModel:
    """A table with its defaults and examples; keys that have neither are None."""
    values: dict[str, object] = {}
    for key, field in table.model_fields.items():
        value = None if field.is_required() else field.get_default(call_default_factory=True)
        values[key] = field.examples[0] if value is None and field.examples else value
    return table.model_construct(None, **values)


def commented_table(kind: str, heading: str, values: BaseModel | None = None, **parts: BaseModel) -> str:
    """A table to insert: every key with a value, and a comment that explains it; keys without a value are comments.

    kind: Of the file, as in `MODELS`.
    heading: As in the file, without brackets.
    values: Values of the keys; by default those of `example`.
    parts: Tables beneath it, that are inserted under headings of their own.
    """
    model = MODELS[kind]
    listed = get_origin(fields_of(model)[heading].annotation) is tuple
    table = values or example(tables_of(model, heading)[0])
    lines = [f"[[{heading}]]" if listed else f"[{heading}]", *_lines(table, parts)]
    for key, part in parts.items():
        lines += [f"[{heading}.{key}]", *_lines(part)]
    return with_explanations("\n".join(lines), model)


def _lines(values: BaseModel, skipped: Collection[str] = ()) -> list[str]:
    lines = []
    for key, field in type(values).model_fields.items():
        value = getattr(values, key)
        nested = isinstance(value, Table) or (isinstance(value, tuple) and value and isinstance(value[0], Table))
        if key not in skipped and not nested:
            lines.append(f"# {key}: {explanation(key, field)}" if value is None else f"{key} = {toml_value(value)}")
    return lines


def _steps(heading: str, counts: dict[str, int]) -> Steps:
    steps: list[int | str] = []
    for end, part in enumerate(heading.split("."), 1):
        steps.append(part)
        if (name := ".".join(heading.split(".")[:end])) in counts:
            steps.append(counts[name])
    return tuple(steps)


def _line(lines: dict[Steps, int], steps: Steps) -> int:
    """The line of the innermost table or key of a location that the text has."""
    steps = tuple(int(step[1:-1]) if isinstance(step, str) and step.startswith("[") else step for step in steps)
    return next((lines[steps[:end]] for end in range(len(steps), 0, -1) if steps[:end] in lines), 0)


def _tables_at(text: str, position: int, model: type[Table]) -> list[type[BaseModel]]:
    """The tables that may be meant at a place of the text, by its heading, inline table and kind."""
    heading, begin = "", 0
    for found in _HEADINGS.finditer(text, 0, position):
        heading, begin = found[1], found.end()
    following = _HEADINGS.search(text, position)
    path, inner = [heading] if heading else [], text[begin : following.start() if following else len(text)]
    if inline := _INLINE.search(text[:position].rpartition("\n")[2]):
        path.append(inline[1])
        inner = text[position - len(inline[2]) :].partition("}")[0]
    tables = tables_of(model, ".".join(path))
    if kind := re.search(r"\bkind\s*=\s*\"([\w-]+)\"", inner):
        kinds = [(table, table.model_fields.get("kind")) for table in tables]
        return [table for table, key in kinds if key and kind[1] in get_args(key.annotation)] or tables
    return tables


def _headings(model: type[Table]) -> list[str]:
    found = []
    for key, field in model.model_fields.items():
        if tables_of(model, key):
            found.append(f"[[{key}]]" if get_origin(field.annotation) is tuple else f"[{key}]")
    return found


def _values(field: FieldInfo) -> list[str]:
    """What a key may hold, as far as it can be listed: choices, true and false, or its default."""
    if choices := choices_of(field):
        return choices
    default = None if field.is_required() else field.get_default(call_default_factory=True)
    if isinstance(default, bool):
        return ["true", "false"]
    return [] if default is None or isinstance(default, Table) else [toml_value(default)]
