"""Messages between processes as JSON objects, one on a line, by msgspec: their only writer and their only reader."""

from __future__ import annotations

import json
import math
import numbers
from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

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
        what, _, where = str(wrong).partition(" - at `$")
        place = where.strip(".`")
        raise MessageError(f"{place}: {what}" if place else what) from None


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
        raise ValueError("Expected a number")
    try:
        return float(value)
    except OverflowError:
        raise ValueError("Expected a finite number") from None


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
