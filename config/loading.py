"""From files to validated configuration; whatever is wrong is one line with file, key and value."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from config.calibration_file import FORMAT, FORMAT_VERSION, CalibrationRecord
from config.mistakes import one_line, printable, shown
from storage.errors import InputError
from storage.text_file import read_text

Model = TypeVar("Model", bound=BaseModel)


def load_calibration(path: Path) -> CalibrationRecord:
    """Read a calibration file.

    Parameters
    ----------
    path : Path
        The file, as `wavefocus calibrate` writes it.

    Raises
    ------
    InputError
        Anything in the file is wrong, or it is of another format or version.
    """
    data = read_toml(path)
    if data.get("format") == FORMAT and data.get("format_version") != FORMAT_VERSION:
        version = shown(data.get("format_version"))
        raise InputError(f"{path}: format_version = {version}: must be {FORMAT_VERSION}; a newer wavefocus wrote it")
    return validated(CalibrationRecord, data, str(path))


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file into plain tables.

    Raises
    ------
    InputError
        The file cannot be read or is not TOML; the message names the line.
    """
    try:
        text = read_text(path)
    except InputError as error:
        raise InputError(printable(str(error))) from None
    return parse_toml(text, str(path))


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """Read TOML text into plain tables.

    Parameters
    ----------
    text : str
        The text.
    source : str
        Where it comes from, for messages.

    Raises
    ------
    InputError
        It is not TOML; the message names the line.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(printable(f"{source}: not TOML: {error}")) from None
    except (RecursionError, ValueError):  # ValueError: a whole number of thousands of digits
        raise InputError(printable(f"{source}: not TOML: nested too deeply, or a number too long")) from None


def validated(model: type[Model], data: object, source: str) -> Model:
    """Validate plain tables against a model.

    Raises
    ------
    InputError
        One line with the first few mistakes.
    """
    try:
        return model.model_validate(data)
    except ValidationError as failure:
        raise InputError(one_line(source, failure, model, data)) from None


def named_file(path: Path, key: str, name: str) -> Path:
    """Find a file that a configuration names.

    Parameters
    ----------
    path : Path
        The configuration's own file; the name is relative to its folder.
    key : str
        Where it names it, for messages.
    name : str
        The name.

    Raises
    ------
    InputError
        There is no such file.
    """
    try:
        named = path.parent / name
        if named.is_file():
            return named
    except (OSError, ValueError):  # a name that no file can have
        pass
    raise InputError(printable(f"{path}: {key} = {shown(name)}: must be a file; none found from {path.parent}/"))
