"""Frozen dataclasses as JSON objects, one on a line: the only writer and the only reader of messages.

Standard library only: ``wavefocus status`` reads a log in less time than pydantic takes to import.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from datetime import datetime
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin, get_type_hints


class MessageError(ValueError):
    """A JSON object is not a message that is expected; the text names key, value and what is allowed."""


@dataclass(frozen=True)
class Message:
    """Base class of messages; keywords of a subclass are its fixed keys: ``class Muted(Message, event="muted")``.

    Of a `sparse` message the keys that are None are left out.
    """

    tag: ClassVar[Mapping[str, str]] = {}
    sparse: ClassVar[bool] = False

    def __init_subclass__(cls, **tag: str) -> None:
        super().__init_subclass__()
        if tag:
            cls.tag = tag


AnyMessage = TypeVar("AnyMessage", bound=Message)
Content = TypeVar("Content")


def to_record(message: Message) -> dict[str, object]:
    """A message as a JSON-ready object; figures that are not finite become None, for JSON has no NaN."""
    content = _plain_fields(message)
    if message.sparse:
        content = {key: value for key, value in content.items() if value is not None}
    return {**message.tag, **content}


def to_line(message: Message) -> str:
    """A message as a line of JSON, with its end."""
    return json.dumps(to_record(message), allow_nan=False) + "\n"


def from_record(kind: type[Content], record: Mapping[str, object], *, strict: bool = False) -> Content:
    """An object as an instance of a dataclass; figures that are None become NaN.

    Keys that are not fields are passed over, for a later version may have added them, or refused if `strict`.
    Raises MessageError.
    """
    types: dict[str, Any] = _field_types(kind)  # type: ignore[arg-type]
    tag: Mapping[str, str] = getattr(kind, "tag", {})
    if strict and (unknown := [key for key in record if key not in types and key not in tag]):
        raise MessageError(f"{unknown[0]} is not known; allowed: {', '.join(types) or 'none'}")
    found = {}
    for field in fields(kind):  # type: ignore[arg-type]
        if field.name in record:
            found[field.name] = _read(types[field.name], record[field.name], field.name)
        elif field.default is MISSING and field.default_factory is MISSING:
            raise MessageError(f"{field.name} is missing")
    return kind(**found)


def message_of(record: Mapping[str, object], kinds: Iterable[type[AnyMessage]]) -> AnyMessage | None:
    """The message that an object is, of the kinds expected; None where it is of another kind.

    Raises MessageError: its kind is expected, its content is wrong.
    """
    for kind in kinds:
        if all(record.get(key) == value for key, value in kind.tag.items()):
            return from_record(kind, record)
    return None


@cache
def _field_types(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in fields(kind)}


def _plain_fields(content: Any) -> dict[str, object]:
    return {field.name: _plain(getattr(content, field.name)) for field in fields(content)}


def _plain(value: Any) -> object:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    return _plain_fields(value) if is_dataclass(value) else value


_SIMPLE: Mapping[type, tuple[tuple[type, ...], str]] = {
    float: ((int, float), "a finite number"),
    int: ((int,), "a whole number"),
    str: ((str,), "text"),
    bool: ((bool,), "true, false"),
    NoneType: ((NoneType,), "null"),
}


def _read(kind: Any, value: Any, key: str) -> Any:
    """A value as a field's type; MessageError where it is none."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Any or kind is object:
        return value
    if kind in _SIMPLE:
        types, allowed = _SIMPLE[kind]
        if kind is float and value is None:
            return math.nan
        if not isinstance(value, types) or (isinstance(value, bool) and kind is not bool):
            raise MessageError(f"{key} is {value!r}; allowed: {allowed}")
        try:
            return float(value) if kind is float else value  # type: ignore[arg-type]
        except OverflowError:
            raise MessageError(f"{key} is {value!r}; allowed: {allowed}") from None
    if origin in (Union, UnionType):
        return _first_of(parts, value, key)
    if origin is Literal:
        if value not in parts:
            raise MessageError(f"{key} is {value!r}; allowed: {', '.join(str(part) for part in parts)}")
        return value
    if origin is tuple:
        if not isinstance(value, list | tuple) or (parts[-1] is not ... and len(value) != len(parts)):
            raise MessageError(f"{key} is {value!r}; allowed: a list")
        each = [parts[0]] * len(value) if parts[-1] is ... else parts
        return tuple(_read(part, one, key) for part, one in zip(each, value, strict=True))
    if not isinstance(kind if origin is None else origin, type):
        raise TypeError(f"{key}: a message cannot hold {kind}")
    if issubclass(origin or kind, Mapping):
        if not isinstance(value, Mapping):
            raise MessageError(f"{key} is {value!r}; allowed: an object")
        return {name: _read(parts[1], one, key) for name, one in value.items()} if parts else value
    try:
        if issubclass(kind, Enum):
            return kind(value)
        if issubclass(kind, datetime):
            at = datetime.fromisoformat(value)
            if at.tzinfo is None:
                raise ValueError(value)
            return at
    except (ValueError, TypeError, OverflowError):
        allowed = ", ".join(one.value for one in kind) if issubclass(kind, Enum) else "an instant with a time zone"
        raise MessageError(f"{key} is {value!r}; allowed: {allowed}") from None
    if not isinstance(value, Mapping):
        raise MessageError(f"{key} is {value!r}; allowed: an object")
    return from_record(kind, value)


def _first_of(kinds: Iterable[Any], value: Any, key: str) -> Any:
    # None first: a number that may be missing is None then, not NaN.
    if value is None and NoneType in kinds:
        return None
    failures = []
    for kind in kinds:
        try:
            return _read(kind, value, key)
        except MessageError as failure:
            failures.append(failure)
    raise failures[0]
