"""Arguments of public functions: refused by name where they are not of the type that the signature states."""

import builtins
import math
import os
import sys
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from functools import cache, wraps
from inspect import signature
from itertools import chain, cycle
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, NamedTuple, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from wavefocus.storage.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")

Positions = Sequence[int] | NDArray[np.integer[Any]] | NDArray[np.bool_]
"""Rows of a bank: their numbers, in any order, or a mask with an entry for each row of the bank."""


def bank_rows(positions: Positions, count: int) -> NDArray[np.int64]:
    """Numbers of bank rows, int64 (rows,), from numbers or from a mask of the bank's length.

    positions: Whole numbers from 0 to `count` - 1, or `count` booleans; a single number is a list of one.
    count: Rows of the bank.

    Raises InputError: something else, a row that the bank does not have, or a mask of another length.
    """
    try:
        rows = np.atleast_1d(np.asarray(positions if isinstance(positions, np.ndarray) else list(_listed(positions))))
    except (TypeError, ValueError):  # not a list, or lists of different lengths
        raise _refused("positions", positions, "row numbers of the bank, or a mask") from None
    if rows.ndim == 1 and rows.dtype == np.bool_:
        if len(rows) != count:
            raise InputError(f"positions is a mask of {len(rows)} entries; the bank has {count} rows")
        return np.flatnonzero(rows)
    if not rows.size:
        return np.zeros(0, np.int64)
    if rows.ndim != 1 or rows.dtype.kind not in "iu":
        raise _refused("positions", positions, "row numbers of the bank, or a mask")
    if (outside := rows[(rows < 0) | (rows >= count)]).size:
        raise InputError(f"positions holds {outside[0]}; allowed are 0 to {count - 1}")
    return rows.astype(np.int64)


def bank_row(position: int, count: int, name: str = "position") -> int:
    """One row of a bank. Raises InputError: it is not a whole number, or the bank does not have it."""
    _PLAIN[int].require(name, position)
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

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        types = _types_of(function)
        for name, value in parameters.bind(*args, **kwargs).arguments.items():
            if name != "self":
                types[name].require(name, value)
                if isinstance(value, float) and not math.isfinite(value):
                    raise InputError(f"{name} is {value}; a finite number is needed")
        return function(*args, **kwargs)

    return call


def check_fields(made: Any) -> None:
    """Refuse fields of a dataclass that are not as their annotations say; for `__post_init__`. Raises InputError."""
    types = _types_of(made.__class__)
    for field in fields(made):
        if field.init:
            types[field.name].require(field.name, getattr(made, field.name))


class _Names(dict[str, Any]):
    """Public names that a module imports only for the type checker; a name that is not public fits everything."""

    def __missing__(self, name: str) -> Any:
        if hasattr(builtins, name):
            raise KeyError(name)
        return getattr(sys.modules["wavefocus"], name, Any)


@cache
def _types_of(made: Any) -> dict[str, "_Type"]:
    """Types by name of a function's parameters or a dataclass's fields."""
    names = _Names(sys.modules[made.__module__].__dict__)
    hints = get_type_hints(made, globalns={}, localns=names)
    return {name: _type(hint) for name, hint in hints.items()}


class _Type(NamedTuple):
    """A type that an argument may have: whether a value fits, and its name in a message."""

    fits: Callable[[Any], bool]
    words: str

    def require(self, name: str, value: object) -> None:
        """Refuse a value that does not fit. Raises InputError."""
        if not self.fits(value):
            raise _refused(name, value, self.words)


_PLAIN: dict[Any, _Type] = {
    bool: _Type(lambda value: isinstance(value, bool | np.bool_), "True or False"),
    int: _Type(lambda value: isinstance(value, Integral) and not isinstance(value, bool), "a whole number"),
    float: _Type(lambda value: isinstance(value, Real) and not isinstance(value, bool), "a number"),
    str: _Type(lambda value: isinstance(value, str), "a text"),
    Path: _Type(lambda value: isinstance(value, os.PathLike), "a path"),
    type(None): _Type(lambda value: value is None, "None"),
}


def _type(hint: Any) -> _Type:
    """A type of an annotation; arrays are not looked into."""
    origin, hints = get_origin(hint) or hint, get_args(hint)
    if hint in _PLAIN:
        return _PLAIN[hint]
    if origin is Literal:
        return _Type(lambda value: isinstance(value, str | int) and value in hints, " or ".join(map(repr, hints)))
    if origin is np.ndarray:
        return _Type(lambda value: _is_list(value, Sequence | np.ndarray) or hasattr(value, "__array__"), "a list")
    if origin is Sequence:
        return _Type(lambda value: _is_list(value, Sequence | np.ndarray), "a list")
    if origin is Callable:
        return _Type(callable, "a function")
    parts = [_type(part) for part in hints if part is not Ellipsis]
    if origin in (Union, types.UnionType):
        words = " or ".join(dict.fromkeys(part.words for part in parts))
        return _Type(lambda value: any(part.fits(value) for part in parts), words)
    if origin is tuple:
        length = None if Ellipsis in hints else len(parts)
        words = "a list" if length is None else f"{length} values, each {parts[0].words},"
        return _Type(lambda value: _is_list(value, tuple | list | np.ndarray) and _fit(value, parts, length), words)
    if origin is Mapping:
        return _Type(lambda value: isinstance(value, Mapping) and _fit(chain(*value.items()), parts), "a mapping")
    if not isinstance(origin, type) or origin in (Any, object):
        return _Type(lambda value: True, "another type")
    if getattr(origin, "_is_protocol", False):
        names = [name for name in vars(origin) if not name.startswith("_")]
        return _Type(lambda value: all(hasattr(value, name) for name in names), origin.__name__)
    return _Type(lambda value: isinstance(value, origin), origin.__name__)


def _fit(values: Iterable[Any], parts: Sequence[_Type], length: int | None = None) -> bool:
    """Whether values are of these types in turn, and so many where that is stated."""
    values = list(values)
    return length in (None, len(values)) and all(part.fits(entry) for entry, part in zip(values, cycle(parts)))


def _is_list(value: object, kinds: Any) -> bool:
    return isinstance(value, kinds) and not isinstance(value, str | bytes)


_MAX_SHOWN = 60


def _refused(name: str, value: object, allowed: str) -> InputError:
    if isinstance(value, np.ndarray):
        text = f"an array of {value.dtype}, of shape {value.shape}"
    else:
        text = str(value) if isinstance(value, np.dtype) else repr(value)
        text = text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."
    verb = "are" if allowed.endswith("numbers") and not allowed.startswith("an ") else "is"
    return InputError(f"{name} is {' '.join(text.split())}; {allowed} {verb} needed")


def _listed(values: object) -> Iterable[Any]:
    """Entries of a list, or a single value as one."""
    if isinstance(values, str | bytes):
        raise TypeError
    return values if isinstance(values, Iterable) else (values,)
