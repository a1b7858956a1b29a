"""Messages between processes as JSON objects, one on a line, by msgspec: their only writer and their only reader."""

from __future__ import annotations

import json
import math
import numbers
from collections.abc import Iterable, Mapping
from dataclasses import is_dataclass
from datetime import datetime
from enum import Enum
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta, Struct

if TYPE_CHECKING:
    Number = float
else:
    # JSON has no NaN: msgspec hands the values of any type but its own to `_number`.
    Number = numbers.Real
"""A figure of a message: null in JSON where it is NaN or infinite, and NaN where JSON has null."""

Instant = Annotated[datetime, Meta(tz=True)]


class MessageError(ValueError):
    """A JSON object is not a message that is expected; the text names key, value and what is allowed."""


class Message(Struct, frozen=True):
    """Base class of messages and of their parts."""


class EventMessage(Message, frozen=True, tag_field="event"):
    """Base class of what a command reports; the class keyword `tag` is the value of its key ``event``."""


class OrderMessage(Message, frozen=True, tag_field="order", forbid_unknown_fields=True, omit_defaults=True):
    """Base class of what a command is ordered to do; the class keyword `tag` is the value of its key ``order``."""


class Refused(EventMessage, frozen=True, tag="refused"):
    """An order or an answer is wrong; the sentence says what is allowed."""

    sentence: str


AnyMessage = TypeVar("AnyMessage", bound=Message)
Content = TypeVar("Content")


def tag(kind: type[Message] | Message) -> str:
    """The value of a message's fixed key."""
    return str(kind.__struct_config__.tag)


def to_record(message: Message) -> dict[str, Any]:
    """A message as a JSON-ready object; figures that are not finite become None, for JSON has no NaN."""
    record: dict[str, Any] = _json_ready(msgspec.to_builtins(message, builtin_types=(datetime,), enc_hook=_builtin))
    return record


def to_line(message: Message) -> str:
    """A message as a line of JSON, with its end."""
    return json.dumps(to_record(message), allow_nan=False) + "\n"


def from_record(kind: type[Content], record: Mapping[str, object]) -> Content:
    """An object as a message or another data class.

    Keys that are not fields are passed over, for a later version may have added them, but in orders.
    Raises MessageError.
    """
    try:
        return msgspec.convert(record, kind, dec_hook=_number)
    except msgspec.ValidationError as wrong:
        raise _wrong_key(kind, record) or MessageError(str(wrong)) from None


def message_of(record: Mapping[str, object], kinds: Iterable[type[AnyMessage]]) -> AnyMessage | None:
    """The message that an object is, of the kinds expected; None where it is of another kind.

    Raises MessageError: its kind is expected, its content is wrong.
    """
    for kind in kinds:
        key = kind.__struct_config__.tag_field
        if key is None or record.get(key) == kind.__struct_config__.tag:
            return from_record(kind, record)
    return None


def _number(kind: type, value: object) -> float:
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(value)
    try:
        return float(value)
    except OverflowError:
        raise ValueError(value) from None


def _builtin(value: object) -> object:
    if isinstance(value, float):  # of NumPy
        return float(value)
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"a message cannot hold {value!r}")


def _json_ready(value: Any) -> Any:
    match value:
        case float():
            return value if math.isfinite(value) else None
        case dict():
            return {key: _json_ready(part) for key, part in value.items()}
        case list() | tuple():
            return [_json_ready(part) for part in value]
        case datetime():
            return value.isoformat()
    return value


def _wrong_key(kind: Any, record: Mapping[str, object]) -> MessageError | None:
    """The first key that is wrong, and what is allowed."""
    form, types = msgspec.inspect.type_info(kind), get_type_hints(kind, include_extras=True)
    required = {field.name: field.required for field in form.fields}  # type: ignore[attr-defined]
    if getattr(form, "forbid_unknown_fields", False):
        for key in record:
            if key not in required and key != form.tag_field:  # type: ignore[attr-defined]
                return MessageError(f"{key} is not known; allowed: {', '.join(required) or 'none'}")
    for key, needed in required.items():
        if key not in record:
            if needed:
                return MessageError(f"{key} is missing")
            continue
        if wrong := _wrong_value(types[key], record[key], key):
            return wrong
    return None


def _wrong_value(kind: Any, value: object, key: str) -> MessageError | None:
    try:
        msgspec.convert(value, kind, dec_hook=_number)
    except msgspec.ValidationError:
        inner = [part for part in get_args(kind) if part is not NoneType] or [kind]
        if isinstance(value, Mapping) and (is_dataclass(inner[0]) or hasattr(inner[0], "__struct_fields__")):
            return _wrong_key(inner[0], value)
        in_list = get_origin(kind) is tuple and isinstance(value, list | tuple)
        within = (_wrong_value(inner[0], part, key) for part in value) if in_list else ()  # type: ignore[attr-defined]
        return next(filter(None, within), None) or MessageError(f"{key} is {value!r}; allowed: {_allowed(kind)}")
    return None


_WORDS = {int: "a whole number", str: "text", bool: "true, false", Instant: "an instant with a time zone"}


def _allowed(kind: Any) -> str:
    """What values of a type are, in words."""
    parts = [part for part in get_args(kind) if part is not NoneType]
    if kind in _WORDS:
        return _WORDS[kind]
    if kind in (float, numbers.Real):
        return "a finite number"
    if get_origin(kind) is Literal:
        return ", ".join(map(str, parts))
    if get_origin(kind) in (Union, UnionType):
        return _allowed(parts[0])
    if isinstance(kind, type) and issubclass(kind, Enum):
        return ", ".join(str(member.value) for member in kind)
    return "a list" if get_origin(kind) is tuple else "an object"
