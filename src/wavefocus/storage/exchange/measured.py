"""Responses measured elsewhere: which format a file is of, and what it holds, before it becomes a bank."""

import re
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.options import ImportOptions
from wavefocus.storage import hdf5_reading
from wavefocus.storage.bank.notes import Note
from wavefocus.storage.errors import InputError, WavefocusError
from wavefocus.storage.exchange import IMPORTS, SOME_FORMATS
from wavefocus.storage.hdf5_reading import most_bytes
from wavefocus.storage.text_file import require_regular
from wavefocus.storage.units import LENGTH_WORDS, METRES, green_unit

Float64Array = NDArray[np.float64]

SPARE_BYTES = 64 << 20
UNFOLDS = 100
"""A file may declare so many times its size, and `SPARE_BYTES` more, before it counts as hollow."""


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Responses as a file holds them.

    rows: Of each position in turn, (actuators, samples): real samples of a FIR, or complex values of a frequency
        response; NaN throughout where a position was not measured.
    shape: Positions, actuators, samples.
    position_m, (P, 3): Places of the positions in metres.
    actuator_m, (N, 3): Places of the actuators in metres, NaN where unknown.
    unit: Unit of the responses over that of the drive; empty where the file does not say.
    sample_rate_hz: Rate of real samples; None of a frequency response, unless the file names one.
    frequency_hz: Frequencies of complex values, else None.
    start_s: Time of the first real sample.
    band_hz: Measured band, where the file says one.
    status, uint8 (P,): Status bits, where the file has them.
    quality: (P, N) or (P,) arrays by their names in a bank.
    notes: Those of the bank that the file was exported from.
    read, assumed, left_out: Sentences about the file.
    """

    rows: Iterable[NDArray[Any]]
    shape: tuple[int, int, int]
    position_m: Float64Array
    actuator_m: Float64Array
    unit: str = ""
    sample_rate_hz: float | None = None
    frequency_hz: Float64Array | None = None
    start_s: float = 0.0
    band_hz: tuple[float, float] | None = None
    status: NDArray[np.uint8] | None = None
    quality: dict[str, NDArray[Any]] = field(default_factory=dict)
    notes: tuple[Note, ...] = ()
    read: tuple[str, ...] = ()
    assumed: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


@contextmanager
def readable(path: Path, kind: str) -> Iterator[None]:
    """Raise InputError, naming the file, for whatever a damaged file makes the packages raise that read it."""
    try:
        yield
    except WavefocusError:
        raise
    except MemoryError as error:
        raise InputError(f"{path} takes more memory than there is; import part of it") from error
    except Exception as error:  # a damaged file may raise anything in the packages that read it
        words = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{path} is damaged, or not {kind} ({words})") from error


def _guarded(measured: Measured, path: Path, kind: str) -> Iterator[NDArray[Any]]:
    """Rows of a file as :func:`readable` reads them."""
    with readable(path, kind):
        yield from measured.rows


def require_honest(path: Path, what: str, declared: int, held: int) -> None:
    """Refuse data that declare far more than the file holds, or more than may be read at once."""
    if declared > UNFOLDS * held + SPARE_BYTES or declared > most_bytes():
        raise InputError(
            f"{path}: {what} takes {declared} bytes and the file holds {held}; at most {UNFOLDS} times what it holds,"
            f" and {most_bytes() >> 30} GiB, are read"
        )


def require_plain(text: str, path: Path, what: str) -> str:
    """Return a name from a file; refuses control characters and names longer than 255 characters."""
    if len(text) > 255 or any(unicodedata.category(letter) in ("Cc", "Cf", "Cs") for letter in text):
        raise InputError(f"{path}: {what} is {text[:80]!r}; a short name without control characters is needed")
    return text


def stated_unit(unit: str, drive: str, path: Path) -> str:
    """Unit of the responses over that of the drive, as a file states them; empty where it states neither.

    Raises InputError: the two contradict each other.
    """
    if not unit or not drive:
        return require_plain(unit, path, "response_unit")
    try:
        return green_unit(require_plain(unit, path, "response_unit"), require_plain(drive, path, "drive_unit"))
    except InputError as error:
        raise InputError(str(error) if str(error).startswith(str(path)) else f"{path}: {error}") from None


def blocks(values: Any, row_bytes: int, chunk_rows: int = 1) -> Iterator[NDArray[Any]]:
    """Rows of an array or dataset, read many at once, one after the other."""
    at_once = max(1, chunk_rows, (16 << 20) // max(row_bytes, 1))
    for first in range(0, len(values), at_once):
        yield from np.ascontiguousarray(values[first : first + at_once])


def uniform_step(values: Float64Array, path: Path, what: str, unit: str) -> float:
    """Step of an axis; raises InputError where it is not uniform."""
    if len(values) < 2 or not np.isfinite(values).all():
        raise InputError(f"{path}: {what} has {len(values)} finite values; at least 2, evenly spaced, are needed")
    step = float(values[-1] - values[0]) / (len(values) - 1)
    off = np.abs(values - values[0] - step * np.arange(len(values)))
    worst = int(np.argmax(off))
    if not step > 0 or off[worst] > 0.02 * step:
        raise InputError(
            f"{path}: {what} is not evenly spaced: value {worst} is {values[worst]:.9g} {unit}, and"
            f" {values[0] + step * worst:.9g} {unit} by a step of {step:.6g}; interpolate it to one step first"
        )
    return step


def distinct(points_m: Float64Array) -> tuple[NDArray[np.int64], Float64Array]:
    """Number equal places in order of first appearance: the number of each, and the places."""
    _, first, group = np.unique(np.round(points_m, 9), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    return number[group.reshape(-1)].astype(np.int64), points_m[np.sort(first)]


def from_spherical(places: Float64Array) -> Float64Array:
    """Cartesian coordinates (n, 3) of azimuth and elevation in degrees, and radius (AES69: azimuth from x to y)."""
    azimuth, elevation, radius = np.radians(places[:, 0]), np.radians(places[:, 1]), places[:, 2]
    across = radius * np.cos(elevation)
    return np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), radius * np.sin(elevation)])


def with_z(places: Float64Array) -> Float64Array:
    """Places (n, 2) or (n, 3) as (n, 3); z is 0 where there is none."""
    return places if places.shape[1] == 3 else np.column_stack([places, np.zeros(len(places))])


def length_unit(options: ImportOptions, path: Path, found: str = "") -> float:
    """Metres of one unit of length: of the file's own, or of --length-unit; raises InputError where neither is."""
    name = LENGTH_WORDS.get(found.strip().lower(), found.strip()) or options.length_unit
    if name not in METRES:
        said = f"gives places in {found!r}" if found else "does not say the unit of its places"
        raise InputError(f"{path} {said}; name it with --length-unit {'|'.join(METRES)}")
    return METRES[name]


def chosen_direction(options: ImportOptions, there: Sequence[str], path: Path) -> int:
    """Index of the response direction that is imported; raises InputError where several are there and none is named."""
    if len(there) == 1 and not options.direction:
        return 0
    wanted = re.sub(r"\s", "", options.direction).lower()
    for index, name in enumerate(there):
        if wanted and wanted == name.lower():
            return index
    found = f"direction {options.direction} is not there" if options.direction else f"{len(there)} response directions"
    raise InputError(f"{path}: {found}; choose with --direction {'|'.join(there[:20])}")


_HEAD_BYTES = 16


def recognised(path: Path) -> str:
    """The format of a file or folder, a key of `IMPORTS`, by its content, else by its ending.

    Raises InputError: there is no such file, it is one of our own, or its format is none of them.
    """
    if path.is_dir():
        return "wav"
    require_regular(path)
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    found = next((name for name, form in IMPORTS.items() if head.startswith(form.starts or (b"\0none",))), None)
    if head.startswith(IMPORTS["netcdf"].starts[1]):
        with hdf5_reading.opened(path) as content:
            hdf5_reading.require_sound_texts(content)
            if "format" in content.attrs and "format_version" in content.attrs:
                form = hdf5_reading.text(content, "format")
                raise InputError(f"{path} is a file of this program ({form}); it is read without an import")
            found = "sofa" if "SOFAConventions" in content.attrs else "netcdf"
    found = found or next((name for name, form in IMPORTS.items() if path.suffix.lower() in form.endings), None)
    if found is None:
        raise InputError(f"{path} is of no format that is recognised; name it with --from {'|'.join(IMPORTS)}")
    return found


@contextmanager
def opened(path: Path, kind: str, options: ImportOptions) -> Iterator[Measured]:
    """Open a file or folder of a format, a key of `IMPORTS`; rows are read while it is open.

    Raises InputError: it cannot be read, or a fact is missing that an option can give; also while rows are read.
    """
    form = IMPORTS[kind]
    for option in sorted(SOME_FORMATS.difference(form.options)):
        if getattr(options, option):
            raise InputError(f"--{option} does not concern {form.title}; leave it out")
    if kind != "wav":
        require_regular(path)
    elif not path.is_dir():
        raise InputError(f"{path} is not a folder; --from wav needs a folder of WAV files")
    with ExitStack() as stack:
        with readable(path, form.title):
            measured: Measured = import_module(f"wavefocus.storage.exchange.{form.module}").read(path, options, stack)
        yield replace(measured, rows=_guarded(measured, path, form.title))
