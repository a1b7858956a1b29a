"""Shared by the tables of every configuration file: strict numbers, closed tables, mistakes, keys of single drivers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Protocol

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, StrictBool
from pydantic_core import PydanticCustomError

from config.loading import shown

# Strict: "20" and true are no numbers in TOML, and guessing would hide a slip of the pen.
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Finite, Field(gt=0)]
NonNegative = Annotated[Finite, Field(ge=0)]
Whole = Annotated[int, Strict()]
Switch = StrictBool
Text = Annotated[str, Strict(), Field(min_length=1)]
PointMm = tuple[Finite, Finite]


class Table(BaseModel):
    """A table of a configuration file: immutable, and closed to keys that it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True)


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
    """Let a text pass that matches a pattern as a whole; others are told what is allowed, not the pattern.

    Parameters
    ----------
    pattern : str
        A regular expression.
    allowed : str
        What the text may be, as the end of a sentence.
    """

    def check(text: str) -> str:
        if not re.fullmatch(pattern, text):
            raise mistake("", text, allowed)
        return text

    return AfterValidator(check)


class _Driven(Protocol):
    @property
    def driver(self) -> str: ...


def with_driver_defaults(data: Any, default_driver: str, defaults: Mapping[str, Mapping[str, object]]) -> Any:
    """Fill in a driver's own defaults, so that the validated table says everything outright.

    Parameters
    ----------
    data : mapping or anything
        The table before validation; what is no table is passed on, to be refused by the model.
    default_driver : str
        The driver of a table that names none.
    defaults : mapping from driver to mapping from key to value
        What each driver's keys are where they are left out.
    """
    if not isinstance(data, dict):
        return data
    driver = data.get("driver", default_driver)
    own = defaults.get(driver, {}) if isinstance(driver, str) else {}
    given = {key: value for key, value in data.items() if value is not None or key not in own}
    return {**own, **given}


def check_driver_keys(section: _Driven, drivers_of: Mapping[str, Sequence[str]], needed: Mapping[str, str]) -> None:
    """Refuse keys that belong to another driver, and miss those that this one cannot do without.

    Parameters
    ----------
    section : table with a driver
        After validation; keys that were left out are None.
    drivers_of : mapping from key to drivers
        Which drivers know it.
    needed : mapping from key to str
        Keys that every driver that knows them needs, and what they hold, for the message.

    Raises
    ------
    PydanticCustomError
        A mistake that names the key.
    """
    for key, drivers in drivers_of.items():
        value = getattr(section, key)
        if value is not None and section.driver not in drivers:
            names = _either([shown(driver) for driver in drivers])
            raise mistake(key, value, f"belongs to driver {names}; the driver here is {shown(section.driver)}")
        if value is None and section.driver in drivers and key in needed:
            raise mistake(key, None, f"is missing; driver {shown(section.driver)} needs {needed[key]}")


def _either(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"
