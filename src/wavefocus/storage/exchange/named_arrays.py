"""Banks and frequency responses as arrays with names, as NumPy, MATLAB and netCDF files hold them.

NumPy's own files (NPY, NPZ) are written and read here; pickled arrays are never read.
"""

import zipfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.options import ImportOptions
from wavefocus.storage.bank.layout import quality_shape
from wavefocus.storage.bank.ledger import QUALITY_NAMES
from wavefocus.storage.bank.notes import notes_of
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.exported_rows import ExportedRows, OnProgress
from wavefocus.storage.exchange.measured import (
    Float64Array,
    Measured,
    blocks,
    chosen_direction,
    require_honest,
    stated_unit,
    uniform_step,
    with_z,
)
from wavefocus.storage.exchange.places import table_of
from wavefocus.storage.hdf5_reading import most_bytes
from wavefocus.storage.output_files import replacement
from wavefocus.storage.text_file import read_text
from wavefocus.storage.units import METRES, require_unit

_MAGIC = b"\x93NUMPY"


def _mapped_array(path: Path) -> NDArray[Any]:
    """The array of an NPY file, read as it is used; a pickled one is refused."""
    with path.open("rb") as file:
        _, declared = _array_header(file, path)
        held = path.stat().st_size
    if declared > held:
        raise InputError(f"{path} is truncated: it declares {declared} bytes and holds {held}")
    return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))


def _array_header(file: IO[bytes], path: Path) -> tuple[np.dtype[Any], int]:
    """Type and bytes of an array in NPY form."""
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(file)
    if dtype.hasobject:
        raise InputError(f"{path} holds pickled objects, which are never read; save plain numbers")
    return dtype, int(np.prod([int(extent) for extent in shape], dtype=object)) * dtype.itemsize


_AXES = ("position", "actuator", "sample")
_OURS = (
    "green", "green_real", "green_imag", "sample_rate_hz", "time_s", "frequency_hz", "band_hz", "response_unit",
    "drive_unit", "status", *(f"position_{unit}" for unit in METRES), *(f"actuator_{unit}" for unit in METRES),
    *(f"quality_{name}" for name in QUALITY_NAMES),
)  # fmt: skip


def bank_arrays(rows: ExportedRows, on_progress: OnProgress | None) -> dict[str, Any]:
    """Rows of an export by name, with all that describes them; their numbers in the bank begin at 0."""
    bank = rows.bank
    arrays: dict[str, Any] = {
        "green": rows.green(on_progress),
        "position": rows.row,
        "position_mm": rows.position_mm,
        "actuator_mm": bank.actuator_mm,
        "time_s": bank.time_s,
        "sample_rate_hz": np.float64(bank.sample_rate_hz),
        "band_hz": np.array([np.nan, np.nan] if bank.band_hz is None else bank.band_hz),
        "status": rows.status,
        "response_unit": rows.units[0],
        "drive_unit": bank.drive_unit,
    }
    return arrays | {f"quality_{name}": figures[rows.row] for name, figures in bank.quality.items()}


@dataclass(frozen=True, slots=True)
class NamedArrays:
    """The arrays of a file.

    path: The file.
    get: Returns the array or dataset of a name, None where there is none; a text as ``str``.
    names: Names that are there, for messages.
    units: Returns the units that the file states of an array; empty where it states none.
    """

    path: Path
    get: Callable[[str], Any]
    names: Iterable[str]
    units: Callable[[str], str] = lambda name: ""


def measured_arrays(file: NamedArrays, options: ImportOptions) -> Measured:
    """Understand arrays that have the names of our own exports, or are mapped to them by --names.

    Raises InputError: an array is missing or of another shape, or a fact is missing that an option can give.
    """
    path, theirs = file.path, options.names
    if unknown := sorted(set(theirs).difference(_OURS)):
        raise InputError(f"--names: {unknown[0]!r} is not a name of ours; allowed: {', '.join(_OURS)}")

    def find(name: str) -> Any:
        found = file.get(theirs.get(name, name))
        if found is None and name in theirs:
            raise InputError(f"{path} has no array {theirs[name]!r}; there are {_some(file.names)}")
        return found

    def numbers(name: str) -> Float64Array | None:
        found = find(name)
        if found is None:
            return None
        require_unit(path, name, file.units(theirs.get(name, name)))
        return real(found, path, name)

    whole, imaginary = find("green"), find("green_imag")
    if whole is None and imaginary is not None and (given := find("green_real")) is not None:
        _require_room(path, 2 * given.size * 8)
        whole = np.asarray(given[...]) + 1j * np.asarray(imaginary[...])
    if whole is None:
        raise InputError(
            f"{path} has no array 'green' (position, actuator, sample); name the one that is, of"
            f" {_some(file.names)}, as --names green=NAME"
        )
    values = ordered(whole, path, options)
    count, actuators, samples = values.shape
    is_complex = values.dtype.kind == "c"
    position_m, actuator_m = (_places(path, numbers, role) for role in ("position", "actuator"))
    if options.places is not None or position_m is None:
        position_m, actuator_m = table_of(options, path, count, actuators)
    if actuator_m is None:
        actuator_m = np.full((actuators, 3), np.nan)
    for what, places, wanted in (("positions", position_m, count), ("actuators", actuator_m, actuators)):
        if len(places) != wanted:
            raise InputError(
                f"{path}: has places of {len(places)} {what} and responses of {wanted}; name the order of the axes with"
                " --axes, as actuator,position,sample"
            )
    rate_hz, frequency_hz, start_s = _axis(path, options, numbers, samples, is_complex=is_complex)
    band, unit, drive = numbers("band_hz"), find("response_unit"), find("drive_unit")
    unit = stated_unit(unit if isinstance(unit, str) else "", drive if isinstance(drive, str) else "", path)
    status = numbers("status")
    status = None if status is None else np.nan_to_num(status)  # missing, as what was not measured
    if status is not None and not (status.size == count and np.isin(status, np.arange(32)).all()):
        raise InputError(f"{path}: status needs a sum of 1, 2, 4, 8 and 16 for each of the {count} positions")
    return Measured(
        rows=blocks(values, actuators * samples * values.dtype.itemsize, (getattr(values, "chunks", None) or (1,))[0]),
        shape=(count, actuators, samples),
        position_m=position_m,
        actuator_m=actuator_m,
        unit=unit,
        sample_rate_hz=rate_hz,
        frequency_hz=frequency_hz,
        start_s=start_s,
        band_hz=None if band is None or band.size != 2 or np.isnan(band).any() else (float(band[0]), float(band[1])),
        status=None if status is None else status.reshape(-1).astype(np.uint8),
        quality=_quality(numbers, count, actuators),
        left_out=_left_out(file.names, theirs),
    )


def ordered(values: Any, path: Path, options: ImportOptions) -> Any:
    """An array or dataset as (position, actuator, sample); it is read whole where its axes are in another order."""
    if getattr(values, "dtype", np.dtype("O")).kind not in "fiuc" or not 2 <= values.ndim <= 4 or not values.size:
        raise InputError(
            f"{path}: the responses are not an array of numbers with 2 to 4 axes; (position, actuator, sample)"
        )
    default = {2: ("position", "sample"), 3: _AXES, 4: ("position", "actuator", "direction", "sample")}[values.ndim]
    given = {"time": "sample", "frequency": "sample", "tap": "sample"}
    axes = tuple(given.get(axis.strip(), axis.strip()) for axis in options.axes.split(",")) if options.axes else default
    if len(axes) != values.ndim or len(set(axes)) < len(axes) or not {"sample"} <= set(axes) <= {*_AXES, "direction"}:
        raise InputError(
            f"--axes is {options.axes!r}; the {values.ndim} axes of shape {tuple(values.shape)} are needed, of"
            " position, actuator, direction, sample, each once"
        )
    if axes == _AXES:
        return values
    _require_room(path, values.size * values.dtype.itemsize)
    array = np.asarray(values[...])
    if "direction" in axes:
        axis = axes.index("direction")
        names = [str(index) for index in range(array.shape[axis])]
        array = np.take(array, chosen_direction(options, names, path), axis)
        axes = tuple(name for name in axes if name != "direction")
    for name in _AXES:
        if name not in axes:
            array, axes = array[None], (name, *axes)
    return array.transpose([axes.index(name) for name in _AXES])


def _frequencies_of(options: ImportOptions, path: Path, samples: int) -> Float64Array:
    """Frequencies in Hz that --frequencies gives, float64 (samples,)."""
    if options.frequencies is None:
        raise InputError(
            f"{path} holds complex responses and no frequencies; give them with --frequencies FIRST,STEP (in Hz) or"
            " --frequencies FILE.npy (or .csv, .txt)"
        )
    if isinstance(options.frequencies, tuple):
        first, step = options.frequencies
        return first + step * np.arange(samples, dtype=np.float64)
    file = options.frequencies
    if file.suffix == ".npy":
        found = real(_mapped_array(file), file, "frequencies").reshape(-1)
    else:
        content = read_text(file)
        if ";" in content or "\t" in content:  # commas are decimal ones
            content = content.replace(",", ".").replace(";", " ")
        try:
            found = np.array([float(word) for word in content.replace(",", " ").split()])
        except ValueError:
            raise InputError(f"{file}: --frequencies needs only numbers, in Hz") from None
    if len(found) != samples:
        raise InputError(
            f"{file}: holds {len(found)} frequencies and {path} responses at {samples}; as many are needed"
        )
    return found


def real(values: Any, path: Path, name: str) -> Float64Array:
    """A small array of real numbers as float64."""
    if getattr(values, "dtype", np.dtype("O")).kind not in "fiub" or values.size > 1 << 24:
        raise InputError(f"{path}: {name} is not an array of real numbers, or longer than 16 million")
    return np.asarray(values[...], np.float64)


def _places(path: Path, numbers: Callable[[str], Float64Array | None], role: str) -> Float64Array | None:
    """Places in metres; where they are there in several units, all must agree."""
    named: dict[str, Float64Array] = {}
    for unit, metres in METRES.items():
        found = numbers(f"{role}_{unit}")
        if found is not None:
            places = np.atleast_2d(found)
            if places.ndim != 2 or places.shape[1] not in (2, 3):
                raise InputError(f"{path}: {role}_{unit} has shape {found.shape}; ({role}, 2 or 3) is needed")
            named[f"{role}_{unit}"] = with_z(places * metres)
    if not named:
        return None
    first = next(iter(named.values()))
    for places in named.values():
        if places.shape != first.shape or not np.allclose(places, first, rtol=1e-6, atol=1e-9, equal_nan=True):
            raise InputError(f"{path}: {' and '.join(named)} are different places; leave one out")
    return first


def _axis(
    path: Path, options: ImportOptions, numbers: Callable[[str], Float64Array | None], samples: int, *, is_complex: bool
) -> tuple[float | None, Float64Array | None, float]:
    """Sample rate, frequencies and time of the first sample."""
    rate = numbers("sample_rate_hz")
    rate_hz = float(rate.reshape(-1)[0]) if rate is not None and rate.size else None
    if is_complex:
        rate_hz = options.sample_rate_hz or rate_hz
        found = numbers("frequency_hz")
        if found is None or options.frequencies:
            found = _frequencies_of(options, path, samples)
        if found.size != samples:
            raise InputError(
                f"{path}: frequency_hz has {found.size} values and the responses {samples}; as many needed"
            )
        return rate_hz, found.reshape(-1), 0.0
    time_s, start_s = numbers("time_s"), 0.0
    if time_s is not None and time_s.size != samples:
        raise InputError(
            f"{path}: time_s has {time_s.size} values and the responses {samples} samples; as many are needed, or"
            " another order of the axes with --axes"
        )
    if time_s is not None and samples > 1:
        step = uniform_step(time_s.reshape(-1), path, "time_s", "s")
        start_s = float(time_s.reshape(-1)[0])
        if rate_hz and abs(rate_hz * step - 1.0) > 1e-3:
            raise InputError(
                f"{path}: sample_rate_hz is {rate_hz:.9g}, and time_s has {1.0 / step:.9g} samples a second; they must"
                " agree"
            )
        rate_hz = rate_hz or 1.0 / step
    rate_hz = rate_hz or options.sample_rate_hz
    if rate_hz is None or not (np.isfinite(rate_hz) and rate_hz > 0):
        raise InputError(f"{path} does not say its sample rate; name it with --sample-rate-hz")
    return rate_hz, None, start_s


def _quality(
    numbers: Callable[[str], Float64Array | None], count: int, actuators: int
) -> dict[str, NDArray[np.float64]]:
    found = {}
    for name in QUALITY_NAMES:
        values = numbers(f"quality_{name}")
        shape = quality_shape(name, count, actuators)
        if values is not None and values.size == int(np.prod(shape)):
            found[name] = values.reshape(shape)
    return found


def _left_out(names: Iterable[str], theirs: Mapping[str, str]) -> tuple[str, ...]:
    used = {*_OURS, *theirs.values(), "position", "axis", "actuator"}
    rest = sorted(name for name in names if name not in used)
    return (f"arrays {_some(rest)}",) if rest else ()


def _some(names: Iterable[str]) -> str:
    shown = [repr(name[:40]) for name in sorted(names)]
    return ", ".join(shown[:12]) + (f" and {len(shown) - 12} more" if len(shown) > 12 else "") or "none"


def _require_room(path: Path, needed: int) -> None:
    if needed > most_bytes():
        raise InputError(f"{path}: its responses take {needed >> 30} GiB at once; WAVEFOCUS_MOST_GIB allows more")


def write(path: Path, rows: ExportedRows, on_progress: OnProgress | None = None) -> None:
    """Write an archive that is read without pickle."""
    with replacement(path) as temporary, temporary.open("wb") as file:
        texts = {f"publication_{key}": text for key, text in rows.publication.items()}
        np.savez(file, **(bank_arrays(rows, on_progress) | texts))


def read(path: Path, options: ImportOptions, stack: ExitStack) -> Measured:
    """Read an archive of arrays, or one array as ``green``, whose places and axes options give; never pickled ones."""
    with path.open("rb") as file:
        is_array = file.read(len(_MAGIC)) == _MAGIC
    if is_array:
        return measured_arrays(NamedArrays(path, {"green": _mapped_array(path)}.get, ("green",)), options)
    archive = stack.enter_context(zipfile.ZipFile(path))
    members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}

    def get(name: str) -> Any:
        if name not in members:
            return None
        info = members[name]
        require_honest(path, f"array {name[:40]!r}", info.file_size, info.compress_size)
        with archive.open(info) as member:
            dtype, declared = _array_header(member, path)
        require_honest(path, f"array {name[:40]!r}", declared, info.file_size)
        with archive.open(info) as member:
            array = np.lib.format.read_array(member, allow_pickle=False)
        return str(array) if dtype.kind == "U" and array.size == 1 else array

    notes = notes_of(str(get("publication_notes") or ""))
    return replace(measured_arrays(NamedArrays(path, get, members), options), notes=notes)
