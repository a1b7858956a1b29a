"""Shared by the tables of every configuration file: strict numbers, closed tables, mistakes."""

from __future__ import annotations

import re
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, StrictBool
from pydantic_core import PydanticCustomError

# Strict: "20" and true are no numbers in TOML, and guessing would hide a slip of the pen.
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[Finite, Field(gt=0)]
NonNegative = Annotated[Finite, Field(ge=0)]
Whole = Annotated[int, Strict()]
Switch = StrictBool
Text = Annotated[str, Strict(), Field(min_length=1)]
PointMm = tuple[Finite, Finite]


class Table(BaseModel):
    """A table of a configuration file: immutable, and closed to unknown keys."""

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
    """Let a text pass that matches a pattern as a whole; for others the message says what is allowed, not the pattern.

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
