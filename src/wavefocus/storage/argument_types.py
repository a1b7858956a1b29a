"""Arguments of public functions: refused by name where they are not of the type that the signature states."""

import builtins
import math
import os
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from functools import wraps
from inspect import signature
from numbers import Integral, Real
from pathlib import Path
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from wavefocus.storage.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")

Positions = Sequence[int] | NDArray[np.integer[Any]] | NDArray[np.bool_]
"""Rows of a bank: their numbers, in any order, or a mask with an entry for each row of the bank."""


def bank_rows(positions: Positions, count: int, name: str = "positions") -> NDArray[np.int64]:
    """Numbers of bank rows, int64 (rows,), from numbers or from a mask of the bank's length.

    positions: Whole numbers from 0 to `count` - 1, or `count` booleans; a single number is a list of one.
    count: Rows of the bank.

    Raises InputError: something else, a row that the bank does not have, or a mask of another length.
    """
    try:
        rows = np.atleast_1d(np.asarray(positions if isinstance(positions, np.ndarray) else list(_listed(positions))))
    except (TypeError, ValueError):  # not a list, or lists of different lengths
        raise _refused(name, positions, "row numbers of the bank, or a mask") from None
    if rows.ndim == 1 and rows.dtype == np.bool_:
        if len(rows) != count:
            raise InputError(f"{name} is a mask of {len(rows)} entries; the bank has {count} rows")
        return np.flatnonzero(rows)
    if not rows.size:
        return np.zeros(0, np.int64)
    if rows.ndim != 1 or rows.dtype.kind not in "iu":
        raise _refused(name, positions, "row numbers of the bank, or a mask")
    if (outside := rows[(rows < 0) | (rows >= count)]).size:
        raise InputError(f"{name} holds {outside[0]}; allowed are 0 to {count - 1}")
    return rows.astype(np.int64)


def bank_row(position: int, count: int, name: str = "position") -> int:
    """One row of a bank. Raises InputError: it is not a whole number, or the bank does not have it."""
    if not _fits(position, int):
        raise _refused(name, position, "a whole number")
    if not 0 <= position < count:
        raise InputError(f"{name} is {position}; allowed are 0 to {count - 1}")
    return int(position)


def real_array(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Real numbers as float64. Raises InputError: there is anything else among them."""
    return reals(name, values).astype(np.float64, copy=False)


def reals(name: str, values: ArrayLike) -> NDArray[Any]:
    """Real numbers of any type as an array. Raises InputError: there is anything else among them."""
    try:
        array = np.asarray(values)
    except ValueError:
        raise _refused(name, values, "numbers in rows of equal length") from None
    if array.size and array.dtype.kind not in "fiu":
        raise _refused(name, values, "real numbers")
    return array


def whole_array(name: str, values: ArrayLike) -> NDArray[np.int64]:
    """Whole numbers as int64; other numbers are allowed where they are whole. Raises InputError: others are not."""
    array = real_array(name, values)
    with np.errstate(invalid="ignore"):
        whole = np.rint(array) == array
    if not whole.all():
        raise _refused(name, values, "whole numbers")
    return np.asarray(values).astype(np.int64)


def truths(name: str, values: ArrayLike) -> NDArray[np.bool_]:
    """Truth values, or the numbers 0 and 1, as an array. Raises InputError: there is anything else among them."""
    try:
        array = np.asarray(values)
    except ValueError:
        array = np.empty(1, dtype=object)
    if array.dtype.kind not in "biuf" or not np.isin(array, (0, 1)).all():
        raise _refused(name, values, "True or False")
    return array.astype(np.bool_)


def float_type(dtype: DTypeLike) -> np.dtype[Any]:
    """Either of the two types that responses have. Raises InputError: another one."""
    try:
        kind = np.dtype(dtype)
    except TypeError:
        kind = None
    if kind not in (np.float32, np.float64):
        raise _refused("dtype", dtype if kind is None else kind, "float32 or float64")
    return np.dtype(kind)


def require_rate(sample_rate_hz: float) -> None:
    """Refuse a sample rate that is not a number above 0. Raises InputError."""
    if not (math.isfinite(sample_rate_hz) and sample_rate_hz > 0):
        raise InputError(f"sample_rate_hz is {sample_rate_hz}; a rate above 0 is needed")


def require_times(sample_rate_hz: float, start_s: float) -> None:
    """Refuse a sample rate that is not above 0, and a start that is not finite. Raises InputError."""
    require_rate(sample_rate_hz)
    if not math.isfinite(start_s):
        raise InputError(f"start_s is {start_s}; a finite time is needed")


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Refuse arguments of a public function that are not as its annotations say.

    Numbers must be finite, too. Arrays and lists are left to the function. Raises InputError at the call.
    """
    parameters = signature(function)
    hints: dict[str, Any] = {}

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if not hints:
            hints.update(_hints(function))
        for name, value in parameters.bind(*args, **kwargs).arguments.items():
            if name == "self":
                continue
            if not _fits(value, hints[name]):
                raise _refused(name, value, _words(hints[name]))
            if isinstance(value, float) and not math.isfinite(value):
                raise InputError(f"{name} is {value}; a finite number is needed")
        return function(*args, **kwargs)

    return call


def check_fields(made: Any) -> None:
    """Refuse fields of a dataclass that are not as their annotations say; for `__post_init__`. Raises InputError."""
    kind = type(made)
    if kind not in _FIELDS:
        hints = _hints(kind)
        _FIELDS[kind] = {field.name: hints[field.name] for field in fields(kind) if field.init}
    for name, hint in _FIELDS[kind].items():
        if not _fits(value := getattr(made, name), hint):
            raise _refused(name, value, _words(hint))


_FIELDS: dict[type, dict[str, Any]] = {}


class _Names(dict[str, Any]):
    """Public names that a module imports only for the type checker; a name that is not public fits everything."""

    def __missing__(self, name: str) -> Any:
        if hasattr(builtins, name):
            raise KeyError(name)
        return getattr(sys.modules["wavefocus"], name, Any)


def _hints(made: Any) -> dict[str, Any]:
    own = sys.modules[made.__module__].__dict__
    names = _Names(own)
    return get_type_hints(made, globalns={}, localns=names, include_extras=True)


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is of a type; arrays are not looked into."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is Annotated:
        return _fits(value, parts[0])
    if origin is Literal:
        return isinstance(value, str | int) and value in parts
    if hint is None or hint is type(None):
        return value is None
    if hint in _PLAIN:
        return _PLAIN[hint](value)
    if origin is tuple:
        return _fits_tuple(value, parts)
    if origin is Sequence:
        return isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | bytes)
    if origin is Mapping:
        return isinstance(value, Mapping) and all(
            _fits(key, parts[0]) and _fits(entry, parts[1]) for key, entry in value.items()
        )
    if origin is Callable:
        return callable(value)
    kind = origin or hint
    if kind is np.ndarray:
        listed = isinstance(value, Sequence | np.ndarray) or hasattr(value, "__array__")
        return listed and not isinstance(value, str | bytes)
    if not isinstance(kind, type):
        return True
    if getattr(kind, "_is_protocol", False):
        return all(hasattr(value, name) for name in vars(kind) if not name.startswith("_"))
    return isinstance(value, kind)


_PLAIN: dict[Any, Callable[[Any], bool]] = {
    bool: lambda value: isinstance(value, bool | np.bool_),
    int: lambda value: isinstance(value, Integral) and not isinstance(value, bool),
    float: lambda value: isinstance(value, Real) and not isinstance(value, bool),
    Path: lambda value: isinstance(value, os.PathLike),
    Any: lambda value: True,
    object: lambda value: True,
}


def _fits_tuple(value: Any, parts: tuple[Any, ...]) -> bool:
    """Whether a value is a tuple, list or array of the entries that a tuple is stated to have."""
    if not isinstance(value, tuple | list | np.ndarray):
        return False
    if len(parts) == 2 and parts[1] is Ellipsis:
        return all(_fits(entry, parts[0]) for entry in value)
    return len(value) == len(parts) and all(_fits(entry, part) for entry, part in zip(value, parts, strict=True))


def _refused(name: str, value: object, allowed: str) -> InputError:
    if isinstance(value, np.ndarray):
        text = f"an array of {value.dtype}, of shape {value.shape}"
    else:
        text = str(value) if isinstance(value, np.dtype) else repr(value)
        text = text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."
    verb = "are" if allowed.endswith("numbers") and not allowed.startswith("an ") else "is"
    return InputError(f"{name} is {' '.join(text.split())}; {allowed} {verb} needed")


MAX_SHOWN = 60
_WORDS = {
    bool: "True or False", int: "a whole number", float: "a number", str: "a text", Path: "a path", type(None): "None",
}  # fmt: skip


def _words(hint: Any) -> str:
    """A type in words."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(_words(part) for part in parts))
    if origin is Annotated:
        return _words(parts[0])
    if origin is Literal:
        return " or ".join(map(repr, parts))
    if hint in _WORDS:
        return _WORDS[hint]
    if origin is tuple:
        return f"{len(parts)} values, each {_words(parts[0])}," if Ellipsis not in parts else "a list"
    if origin is Callable:
        return "a function"
    if origin is not None and issubclass(origin, Iterable):
        return "a mapping" if issubclass(origin, Mapping) else "a list"
    return getattr(hint, "__name__", "another type")


def _listed(values: object) -> Iterable[Any]:
    """Entries of a list, or a single value as one."""
    if isinstance(values, str | bytes):
        raise TypeError
    return values if isinstance(values, Iterable) else (values,)
