"""A record of every exchange with the instruments of this process, as JSON lines: a laboratory can send it in.

Serial lines note the bytes both ways; mirror, recorder and player note each call.
"""

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import wraps
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np

_FORMAT = "wavefocus-exchanges"
_FORMAT_VERSION = 1
Role = TypeVar("Role")


class ExchangeRecord:
    """Writes exchanges to a file, each at once, so that what hung or crashed is in it.

    failure: Why the rest of it could not be written; empty so far. No instrument fails because a disk is full.
    """

    def __init__(self, file: IO[str], about: dict[str, Any]) -> None:
        self._file = file
        self._began_s = time.monotonic()
        self._lock = threading.Lock()
        self.failure = ""
        self._write({"format": _FORMAT, "format_version": _FORMAT_VERSION, **about})

    def note(self, instrument: str, **what: Any) -> None:
        """Write a line: seconds since the beginning, the instrument, and what happened."""
        self._write({"at_s": round(time.monotonic() - self._began_s, 6), "instrument": instrument, **what})

    def _write(self, line: dict[str, Any]) -> None:
        with self._lock:
            if self.failure:
                return
            try:
                self._file.write(json.dumps(line) + "\n")
                self._file.flush()
            except OSError as full:
                self.failure = full.strerror or type(full).__name__


# Drivers are opened deep inside, in threads of their own; at most one record is made at a time.
_current: list[ExchangeRecord] = []


@contextmanager
def recording(path: Path, about: dict[str, Any]) -> Iterator[ExchangeRecord]:
    """Record the exchanges of all instruments while the block runs. Raises OSError, FileExistsError where it exists.

    about: What the first line says of the rig and the program.
    """
    with path.open("x", encoding="utf-8") as file:
        record = ExchangeRecord(file, about)
        _current.append(record)
        try:
            yield record
        finally:
            _current.remove(record)


def note_exchange(instrument: str, **what: Any) -> None:
    """Add a line to the record, if one is being made; bytes become text, one character each (latin-1)."""
    for record in _current:
        shown = {key: value.decode("latin-1") if isinstance(value, bytes) else value for key, value in what.items()}
        record.note(instrument, **shown)


def noting_calls(instrument: Role, role: str) -> Role:
    """The same instrument, each of whose calls is noted while a record is made."""
    for name in dir(type(instrument)):
        method = getattr(type(instrument), name)
        if not name.startswith("_") and callable(method) and not isinstance(method, type):
            with suppress(AttributeError):  # another distribution's driver may take no new attributes
                setattr(instrument, name, _noted(getattr(instrument, name), role, name))
    return instrument


def _noted(call: Callable[..., Any], role: str, name: str) -> Callable[..., Any]:
    @wraps(call)
    def noted(*arguments: Any, **named: Any) -> Any:
        note_exchange(role, called=name, arguments=_shown((*arguments, named) if named else arguments))
        try:
            answer = call(*arguments, **named)
        except BaseException as failure:
            chain = failure.__cause__
            because = {} if chain is None else {"because": _shown(chain)}
            note_exchange(role, of=name, raised=_shown(failure), **because)
            raise
        note_exchange(role, of=name, returned=_shown(answer))
        return answer

    return noted


def _shown(value: object) -> str:
    """A value as text; long arrays and texts are cut."""
    with np.printoptions(threshold=8, edgeitems=3):
        return repr(value)[:2000]
