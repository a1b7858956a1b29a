"""Writing a calibration file, so that people can read it too."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path

from config.calibration_file import CalibrationRecord
from config.mistakes import printable
from storage.errors import InputError
from storage.output_files import new_file

HEAD = """\
# Measured by wavefocus calibrate; named in rig.toml by [calibration] file, and stronger than what stands there.
"""
NOTES = {
    "mirror": "the projective map (tan x, tan y, 1) ~ map (x_mm, y_mm, 1); residual: by how much it misses each mark",
    "inputs": "how much later the response input is sampled than the reference input",
    "outputs": "latency relative to the loopback output; volts at full scale; polarity -1: wires crossed",
    "actuators": "polarity and level of each, measured at the same distance from it; level against their median",
}


def write_calibration(path: Path, record: CalibrationRecord) -> None:
    """Write a calibration file; one that is there is never overwritten.

    Raises
    ------
    InputError
        The file is there already, or cannot be written.
    """
    text = HEAD + "\n".join(_lines(record))
    try:
        with new_file(path) as temporary:
            temporary.write_bytes((text + "\n").encode())
    except FileExistsError:
        raise InputError(printable(f"{path}: is there already and is not overwritten; name another file")) from None
    except OSError as error:
        raise InputError(printable(f"{path}: cannot be written: {error.strerror or error}")) from None


def _lines(record: CalibrationRecord) -> Iterator[str]:
    data = record.model_dump(exclude_none=True)
    tables = {name: data.pop(name) for name in NOTES if name in data}
    yield from (f"{key} = {_toml(value)}" for key, value in data.items())
    for name, table in tables.items():
        yield ""
        yield f"[{name}]  # {NOTES[name]}"
        rows = [(key, value) for key, value in table.items() if _is_tables(value)]
        yield from (f"{key} = {_toml(value)}" for key, value in table.items() if not _is_tables(value))
        for key, entries in rows:
            yield f"{key} = ["
            yield from (f"    {_toml(entry)}," for entry in entries)
            yield "]"


def _is_tables(value: object) -> bool:
    return isinstance(value, list | tuple) and len(value) > 0 and isinstance(value[0], Mapping)


def _toml(value: object) -> str:
    if isinstance(value, datetime):
        return value.isoformat(timespec="seconds")
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(entry)}" for key, entry in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(entry) for entry in value) + "]"
    if isinstance(value, str):
        return _quoted(value)
    return repr(value)


def _quoted(text: str) -> str:
    """A text as a TOML string."""
    escaped = "".join(
        {'"': '\\"', "\\": "\\\\"}.get(letter, letter if letter.isprintable() else f"\\U{ord(letter):08X}")
        for letter in text
    )
    return f'"{escaped}"'
