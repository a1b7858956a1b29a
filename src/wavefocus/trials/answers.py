"""The answers of an experiment: ``trials.csv``, one row per answer, and ``trials.json``, its facts and columns.

A row is on the disk before its answer counts as stored. What a power cut left of a row that was not is cut off when the
file is opened again; the rows before it stay as they are. Line 1 names the columns: a file may have more than are known
here, and lack those that have a default, in any order.
"""

import csv
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, get_type_hints

from wavefocus.config.trials import CONTROL
from wavefocus.storage import durable
from wavefocus.storage.durable import Closing
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.owner import remove_owner, take_ownership, write_owner
from wavefocus.storage.output_files import write_whole
from wavefocus.storage.sidecar_files import create
from wavefocus.storage.text_file import read_text

ANSWERS, FACTS = "trials.csv", "trials.json"
FORMAT = "wavefocus-trials"
FORMAT_VERSION = 1
_LINE_END = "\r\n"  # RFC 4180
_CODE = re.compile(r"[A-Za-z0-9-]{1,20}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


def _column(
    about: str,
    *,
    unit: str = "",
    levels: Mapping[str, str] | None = None,
    least: int | None = None,
    absent: Any = MISSING,
) -> Any:
    """A column: its description, and its value where a file lacks it.

    least: Of a whole number. absent: A column that a later version adds has it.
    """
    description = {"Description": about, **({"Units": unit} if unit else {}), **({"Levels": levels} if levels else {})}
    return field(metadata={"description": description, "least": least, "absent": absent})


@dataclass(frozen=True, slots=True)
class Row:
    """One answer. Fields that are None, and empty texts, are empty in the file."""

    participant: str = _column("Code of the participant")
    block: int = _column("Number of the block, from 1", least=1)
    trial: int = _column("Number of the trial in the order of this participant, from 1", least=1)
    track: str = _column("Adaptive track that the trial belongs to; empty where the design is not adaptive", absent="")
    stimulus: str = _column("Name of the stimulus, that of its drive file in the folder stimuli")
    path: str = _column("Path of the source, by its name in the trials file")
    signal: str = _column("Signal of the source, by its name in the trials file")
    speed_mm_s: float | None = _column("Speed along the path; empty for a point", unit="mm/s", absent=None)
    amplitude: float = _column(
        "Amplitude of the source, in the bank's response unit where the design normalises; 0: no stimulus"
    )
    plays: int = _column("Plays of the stimulus in one presentation", least=1, absent=1)
    answer: str = _column("The participant's answer")
    correct: bool | None = _column(
        "Whether the answer is right; empty where the design has no right answer",
        levels={"true": "right", "false": "wrong"}, absent=None,
    )  # fmt: skip
    reaction_s: float = _column(
        "From the onset of the last presentation, as the recorder's loopback shows it, to the answer", unit="s"
    )
    onset_error_ms: float | None = _column(
        "Onset by the recorder's loopback minus the onset by the request to play and the player's stated latency; empty"
        " where the player states none", unit="ms", absent=None,
    )  # fmt: skip
    onset_within_ms: float = _column(
        "Uncertainty of the onset on the machine's clock, to either side, and so of reaction_s: half of the time that"
        " the start of the record took", unit="ms",
    )  # fmt: skip
    replays: int = _column("How often the participant asked for the stimulus again", least=0, absent=0)
    attempts: int = _column(
        "Presentations begun for this answer but for replays; more than 1 where an instrument was lost, or the onset"
        " was not found, and the trial was repeated", least=1, absent=1,
    )  # fmt: skip
    by: str = _column("Input of the answer", levels={
        "keyboard": "key", "button": "button on the screen, by a pointer", "touch": "button on the screen, by touch",
        "program": "program that answers",
    })  # fmt: skip
    answered_at: str = _column("Instant of the answer, ISO 8601 with time zone")
    stimulus_sha256: str = _column("SHA-256 of the values of the stimulus's drive")
    bank_sha256: str = _column("SHA-256 of the bank file")
    trials_sha256: str = _column("SHA-256 of the trials file, a byte-order mark left out")


COLUMNS: Mapping[str, Mapping[str, Any]] = {one.name: one.metadata["description"] for one in fields(Row)}
"""Description of every column, in their order, as ``trials.json`` has it."""
DEFAULTS = {one.name: one.metadata["absent"] for one in fields(Row) if one.metadata["absent"] is not MISSING}
"""Values of columns that a file may lack."""

_HEADER = ",".join(COLUMNS) + _LINE_END
_SECTOR = 512  # bytes that a disk writes as a whole, at least
_BYTE_ORDER_MARK = "\ufeff".encode()
_TYPES = get_type_hints(Row)
_LEAST = {one.name: one.metadata["least"] for one in fields(Row)}


def check_participant(code: str) -> str:
    """Return a participant's code. Raises InputError: it is none."""
    if not _CODE.fullmatch(code):
        raise InputError(
            f"participant is {code!r}; allowed: a code of 1 to 20 letters, digits and hyphens, and no name"
        )
    return code


class AnswersFile(Closing):
    """The one process that stores answers in a folder; a context manager.

    folder: Of the experiment; it and its ``trials.csv`` are made where missing.

    Raises InputError: the file is a link, holds something that was not written here, or cannot be written.
    BankBusyError: another process stores answers in the folder.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / ANSWERS
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder} is not a folder; name a folder")
        folder.mkdir(parents=True, exist_ok=True)
        _require_no_link(self.path)
        if not self.path.exists():
            create(self.path).close()
            durable.sync_folder(folder)
        self._file = durable.PositionedFile(self.path, write=True)
        try:
            take_ownership(self.path, self._file, "answers file")
            content = bytes(self._file.read(0, self._file.size()))
            self.rows, self._columns, whole = _rows_of(content, self.path)
            self._cut_off(content, whole)
            write_owner(self.path)
        except BaseException:
            self._file.close()
            raise

    def append(self, row: Row) -> None:
        """Store an answer; it is on the disk when this returns.

        Raises InputError: it cannot be written; the answers before it are intact.
        """
        line = _line(row, self._columns)
        try:
            self._file.write(self._end, line)
            self._file.sync()
        except OSError as error:
            with suppress(OSError):
                self._file.truncate(self._end)
            raise InputError(
                f"{self.path} cannot be written: {error.strerror or error}; the answer to trial {row.trial} is not"
                " stored, those before it are: free some space and give the same command again"
            ) from error
        self._end += len(line)
        self.rows = (*self.rows, row)

    def close(self) -> None:
        """Release the file."""
        remove_owner(self.path)
        self._file.close()

    def _cut_off(self, held: bytes, whole: bytes) -> None:
        """Write what the file shall begin with where it does not yet, and drop what follows."""
        self._end = len(whole)
        try:
            if not held.startswith(whole):
                self._file.write(0, whole)
            if len(held) > self._end:
                self._file.truncate(self._end)
            if held != whole:
                self._file.sync()
        except OSError as error:
            raise InputError(
                f"{self.path} cannot be written: {error.strerror or error}; free some space and give the same command"
                " again"
            ) from error


def read_answers(folder: Path) -> tuple[Row, ...]:
    """Read all answers of a folder, also while a session goes on; the file is not changed.

    Raises InputError: there is no file, or it is damaged.
    """
    path = folder / ANSWERS
    if not path.exists():
        raise InputError(f"{folder} holds no {ANSWERS}; name the folder that `wavefocus trials` wrote")
    if not path.is_file():
        raise InputError(f"{path} is not a regular file")
    return _rows_of(path.read_bytes(), path)[0]


def write_facts(folder: Path, facts: Mapping[str, object]) -> None:
    """Write ``trials.json``: the facts of the experiment, and the description of every column.

    Raises InputError: it cannot be written, or is a link.
    """
    _require_no_link(folder / FACTS)
    content = {"format": FORMAT, "format_version": FORMAT_VERSION, **facts, "columns": COLUMNS}
    write_whole(folder / FACTS, json.dumps(content, indent=2, ensure_ascii=False) + "\n")


def read_facts(folder: Path) -> dict[str, Any]:
    """Read ``trials.json``. Raises InputError: it is missing, or holds something else."""
    path = folder / FACTS
    try:
        facts = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is no JSON: it was changed by another program") from None
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        raise InputError(f'{path} is not what `wavefocus trials` wrote: "format" must be "{FORMAT}"')
    if facts.get("format_version", 1) not in range(1, FORMAT_VERSION + 1):
        raise InputError(
            f"{path}: format_version is {facts['format_version']!r}; this version of wavefocus reads up to"
            f" {FORMAT_VERSION}"
        )
    return facts


def _rows_of(content: bytes, path: Path) -> tuple[tuple[Row, ...], tuple[str, ...], bytes]:
    """The rows of a file, its columns, and the part of it that is whole, its header completed."""
    header = _HEADER.encode()
    # New, or a power cut while it was made; the file system may have made room and written nothing.
    if len(content) <= len(header) and header.startswith(content.rstrip(b"\0")):
        return (), tuple(COLUMNS), header
    first, _, body = content.partition(b"\n")
    columns = _columns_of(first.removeprefix(_BYTE_ORDER_MARK), path)
    *lines, rest = body.split(b"\n")
    whole = content[: len(content) - len(rest)]
    while lines and not (lines[-1] + rest).strip():  # blank lines at the end are no rows
        whole, rest = whole[: -len(lines.pop()) - 1], b""
    # Only the last row can be torn: those before it were on the disk before it was written.
    if lines and _is_torn(lines[-1] + b"\n", len(whole)):
        whole = whole[: -len(lines.pop()) - 1]
        rest = b""
    rows = []
    for number, line in enumerate(lines, 2):
        try:
            rows.append(_row(line + b"\n", columns))
        except ValueError as error:
            raise InputError(f"{path}: line {number}: {error}; put the original file back") from None
    # Of a row that lacks no more than its line end nothing is lost; any other was never acknowledged.
    with suppress(ValueError):
        end = rest.removesuffix(b"\r") + _LINE_END.encode()
        rows.append(_row(end, columns))
        whole += end
    return tuple(rows), columns, whole


def _is_torn(line: bytes, end: int) -> bool:
    """Whether a line that ends at a byte of the file was written in part: sectors of the disk are whole, or zeros."""
    first = (end - len(line)) % _SECTOR
    sectors = [line[max(0, start - first) : start - first + _SECTOR] for start in range(0, first + len(line), _SECTOR)]
    return any(not any(part) for part in sectors) and all(0 not in part for part in sectors if any(part))


def _columns_of(line: bytes, path: Path) -> tuple[str, ...]:
    """The columns of a file by its first line. Raises InputError: one is missing that has no default, or is twice."""
    try:
        columns = tuple(_cells(line + b"\n"))
    except ValueError:
        columns = ()
    missing = [name for name in COLUMNS if name not in columns and name not in DEFAULTS]
    twice = [name for name in COLUMNS if columns.count(name) > 1]
    if missing or twice:
        of = f"lacks {', '.join(missing)}" if missing else f"has {', '.join(twice)} more than once"
        raise InputError(
            f"{path}: line 1 {of}; columns are separated by commas, and may be more or fewer only where the page on "
            "trials says so: put the original file back, or name another folder"
        )
    return columns


def _line(row: Row, columns: Sequence[str]) -> bytes:
    """A row as a line of a file with these columns. Raises ValueError: a text holds a line end, a number is not finite.

    A column that is not known here stays empty.
    """
    cells = []
    for name in columns:
        value = getattr(row, name, "")
        if isinstance(value, bool):
            cells.append("true" if value else "false")
        elif isinstance(value, float):
            if not math.isfinite(value):
                raise ValueError(f"{value} is not finite")
            cells.append(repr(float(value)))  # a NumPy number would be written with its type
        else:
            cells.append("" if value is None else str(value))
    text = io.StringIO()
    csv.writer(text, lineterminator=_LINE_END).writerow(cells)
    line = text.getvalue().encode()
    kept = replace(row, **{name: default for name, default in DEFAULTS.items() if name not in columns})
    if _row(line, columns) != kept:
        raise ValueError("a row would not be read as it is")
    return line


def _row(line: bytes, columns: Sequence[str]) -> Row:
    """A line as a row. Raises ValueError."""
    cells = _cells(line)
    if len(cells) != len(columns):
        raise ValueError(f"{len(cells)} columns; {len(columns)} are needed")
    values = {name: _value(name, cell) for name, cell in zip(columns, cells, strict=True) if name in COLUMNS}
    return Row(**{**{name: default for name, default in DEFAULTS.items() if name not in values}, **values})


def _cells(line: bytes) -> list[str]:
    """The cells of a line with its end. Raises ValueError."""
    try:
        text = line.decode()
    except UnicodeDecodeError:
        raise ValueError("not UTF-8 text") from None
    body = text.removesuffix("\n").removesuffix("\r")
    if body == text or re.search(f"[{CONTROL}]", body):
        raise ValueError("not a line that `wavefocus trials` writes")
    try:
        return next(csv.reader([body], strict=True))
    except (csv.Error, StopIteration):
        raise ValueError("not a line that `wavefocus trials` writes") from None


def _value(name: str, cell: str) -> Any:
    """The value of a cell. Raises ValueError."""
    kind = _TYPES[name]
    if not cell and kind not in (str, int, float):
        return None
    if name == "participant" and not _CODE.fullmatch(cell):
        raise ValueError(f"{name} is {cell!r}; allowed: a code of letters, digits and hyphens")
    if name.endswith("_sha256") and not _SHA256.fullmatch(cell):
        raise ValueError(f"{name} is {cell!r}; allowed: 64 hexadecimal digits")
    if name == "correct":
        if cell not in ("true", "false"):
            raise ValueError(f"correct is {cell!r}; allowed: true, false or nothing")
        return cell == "true"
    if kind is str:
        return cell
    if (least := _LEAST[name]) is not None:
        if not re.fullmatch(r"\d{1,9}", cell) or int(cell) < least:
            raise ValueError(f"{name} is {cell!r}; allowed: a whole number, {least} or more")
        return int(cell)
    try:
        number = float(cell)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{name} is {cell!r}; allowed: a finite number")
    return number


def _require_no_link(path: Path) -> None:
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise InputError(f"{path} is not a regular file; remove it, or name another folder")
