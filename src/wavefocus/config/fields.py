"""Shared by the tables of all configuration files: strict numbers, closed tables, mistakes, explanations of keys."""

import json
import re
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, StrictBool, ValidationInfo, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from wavefocus.config.retired import KEYS

# Strict: "20" and true are no numbers in TOML, and guessing would hide a slip of the pen.
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Finite, Field(gt=0)]
NonNegative = Annotated[Finite, Field(ge=0)]
Whole = Annotated[int, Strict()]
Switch = StrictBool
Text = Annotated[str, Strict(), Field(min_length=1)]
PointMm = tuple[Finite, Finite]
Row = tuple[Finite, Finite, Finite]
Matrix = tuple[Row, Row, Row]


@dataclass(frozen=True, slots=True)
class _PlanMark:
    """How a key counts in the hash of a plan; metadata of its field, as ``Annotated[Positive, FREE]``."""

    meaning: str


KEPT: Mapping[str, object] = {"of": "a bank"}
"""Context of a validation of what a bank has kept: keys that are gone are passed over."""
FREE = _PlanMark("may change in a campaign")
DERIVED = _PlanMark("hashed in another form, as the positions that follow from a grid")
ALWAYS = _PlanMark("hashed at its default too, as the first banks were")
"""A key without a mark is hashed where it is not at its default, so that a new key changes no older bank's hash."""


class Table(BaseModel):
    """A table of a configuration file: immutable, and closed to unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _without_retired_keys(cls, data: Any, info: ValidationInfo) -> Any:
        """Pass over keys that are gone, in what a bank has kept."""
        if info.context is not KEPT or not isinstance(data, dict):
            return data
        return {key: value for key, value in data.items() if key in cls.model_fields or key not in KEYS}

    def plan_values(self) -> dict[str, Any]:
        """Keys that a resume must not change, as JSON has them: all that are not marked `FREE` or `DERIVED`."""
        values, plain, unused = {}, self.model_dump(), self._unused_in_plan()
        for key, field in type(self).model_fields.items():
            mark, value, default = plan_mark(field), getattr(self, key), self._plan_default(key)
            if mark in (FREE, DERIVED) or key in unused:
                continue
            if isinstance(value, Table):
                if (nested := value.plan_values()) or default is None:
                    values[key] = nested
            elif mark is ALWAYS or value != default:
                values[key] = plain[key]
        return values

    def _plan_default(self, key: str) -> object:
        """The value of a key that is left out."""
        return type(self).model_fields[key].get_default(call_default_factory=True)

    def _unused_in_plan(self) -> frozenset[str]:
        """Keys without effect beside the values of others."""
        return frozenset()


def default(value: object, description: str, **more: Any) -> Any:
    """A key that may be left out: its value then, what it means, and whatever else pydantic's `Field` takes."""
    return Field(default=value, description=description, **more)


def plan_mark(field: FieldInfo) -> _PlanMark | None:
    """The mark of a key; None where it has none."""
    return next((mark for mark in field.metadata if isinstance(mark, _PlanMark)), None)


def mistake(key: str, value: object, allowed: str) -> PydanticCustomError:
    """Make the error to raise in a validator about one key beneath the table validated.

    Parameters
    ----------
    key : str
        Dotted path from the table: ``"stop_hz"``, ``"capture.taps"``; empty for the value validated itself.
    value : object
        What the key holds.
    allowed : str
        What it may hold, as the end of a sentence: ``"must be below 5000"``.
    """
    context: dict[str, Any] = {"key": key, "value": value, "allowed": allowed}
    return PydanticCustomError("mistake", "{allowed}", context)


def like(pattern: str, allowed: str) -> AfterValidator:
    """Let a text pass that matches a pattern as a whole; for others the message says what is allowed, not the pattern.

    Parameters
    ----------
    pattern : str
        A regular expression.
    allowed : str
        What the text may be, as the end of a sentence.
    """
    form = re.compile(pattern)

    def check(text: str) -> str:
        if not form.fullmatch(text):
            raise mistake("", text, allowed)
        return text

    return AfterValidator(check)


UNITS = {
    "_at_0_v": "",
    "_m_s": "m/s",
    "_mm_s": "mm/s", "_mm": "mm", "_mrad": "mrad", "_deg": "degrees", "_s": "s", "_min": "minutes", "_days": "days",
    "_hz": "Hz", "_v": "V", "_db": "dB", "_ppm": "ppm", "_ohm": "ohm", "_w": "W", "_samples": "samples",
}  # fmt: skip
"""Units by the endings of keys."""
_COLUMN, _WIDTH = 31, 120


def explanation(key: str, field: FieldInfo) -> str:
    """What a key means, in which unit, and what it may be."""
    unit = next((unit for ending, unit in UNITS.items() if key.endswith(ending) and "_per_" not in key), "")
    choices, bounds = _allowed(field)
    brackets = ", ".join(part for part in (unit, bounds) if part)
    return (field.description or "") + (f": {choices}" if choices else "") + (f" ({brackets})" if brackets else "")


def tables_of(model: type[BaseModel], path: str = "") -> list[type[BaseModel]]:
    """The tables that may stand under a heading of a file, as ``"watch.noise"``; none where there is no such table."""
    models = [model]
    for name in path.split(".") if path else ():
        fields = {key: field for table in models for key, field in table.model_fields.items()}
        models = list(models_in(fields[name].annotation)) if name in fields else []
    return models


def fields_of(model: type[BaseModel], path: str = "") -> dict[str, FieldInfo]:
    """The fields of a table of a file, by its heading; none where there is no such table."""
    return {key: field for table in tables_of(model, path) for key, field in table.model_fields.items()}


def with_explanations(text: str, model: type[BaseModel]) -> str:
    """A TOML file with a comment after each ``key = value`` that has none; also where the key is commented out.

    In a list of tables a key is explained where it stands first.
    """
    lines, fields, heading, explained = [], fields_of(model), "", set()
    for line in text.splitlines():
        if found := re.match(r"(?:# )?\[+([\w.]+)\]+", line):
            heading = found[1]
            fields = fields_of(model, heading)
        key = re.match(r"(?:# )?(\w+) = [^#]*[^#\[{(,\s]$", line)
        if key is None or key[1] not in fields or not fields[key[1]].description or (heading, key[1]) in explained:
            lines.append(line)
            continue
        explained.add((heading, key[1]))
        column = max(_COLUMN, len(line) + 2)
        about = textwrap.wrap(explanation(key[1], fields[key[1]]), _WIDTH - _COLUMN - 2)
        if column + 2 + len(about[0]) > _WIDTH:
            lines += [*(f"# {words}" for words in about), line]
        else:
            lines += [f"{line:<{column - 1}} # {about[0]}", *(f"{'#':<{_COLUMN}}# {words}" for words in about[1:])]
    return "\n".join(lines) + "\n"


def toml_table(heading: str, table: Table, changes: Mapping[str, object] | None = None) -> str:
    """A table as a file holds it, keys of None left out; `changes` are other values of some keys."""
    values = {**dict(table), **(changes or {})}
    lines = (f"{key} = {toml_value(value)}" for key, value in values.items() if value is not None)
    return "\n".join([heading, *lines]) + "\n"


def toml_value(value: object) -> str:
    """A value as a file holds it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # TOML escapes as JSON does, and the delete character too.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        return f"[{', '.join(toml_value(entry) for entry in value)}]"
    if isinstance(value, Table):
        return f"{{ {', '.join(f'{key} = {toml_value(entry)}' for key, entry in value)} }}"
    return repr(value)


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """The tables that a type is made of."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from models_in(part)


def choices_of(field: FieldInfo) -> list[str]:
    """The texts that a key may hold, as TOML; none where it may hold any."""
    found: list[str] = []

    def walk(annotation: Any) -> None:
        if get_origin(annotation) is Literal:
            found.extend(json.dumps(choice) for choice in get_args(annotation))
        elif get_origin(annotation) is not tuple:
            for part in get_args(annotation):
                walk(part)

    walk(field.annotation)
    return found


def _allowed(field: FieldInfo) -> tuple[str, str]:
    """Choices and bounds in words; empty where there are none, and of the parts of tuples."""
    bounds: dict[str, float] = {}
    choices = choices_of(field)

    def gather(metadata: Any) -> None:
        for part in metadata:
            bounds.update({name: getattr(part, name) for name in _BOUNDS if getattr(part, name, None) is not None})
            gather(getattr(part, "metadata", ()))

    def walk(annotation: Any) -> None:
        if get_origin(annotation) not in (Literal, tuple):
            gather(getattr(annotation, "__metadata__", ()))
            for part in get_args(annotation):
                walk(part)

    walk(field.annotation)
    gather(field.metadata)
    listed = " or ".join(", ".join(choices).rsplit(", ", 1)) if len(choices) > 1 else ""
    if "ge" in bounds and "le" in bounds and "gt" not in bounds:
        return listed, f"{_number(bounds['ge'])} to {_number(bounds['le'])}"
    return listed, ", ".join(text.format(_number(bounds[name])) for name, text in _BOUNDS.items() if name in bounds)


_BOUNDS = {"gt": "above {}", "ge": "{} or more", "lt": "below {}", "le": "at most {}"}


def _number(value: float) -> str:
    return str(int(value)) if value == int(value) else f"{value:g}"
