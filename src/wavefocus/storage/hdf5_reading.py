"""Reading HDF5 files that others made: plain numbers and text, in this file and no other."""

import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.errors import InputError
from wavefocus.storage.missing import DEFAULT_FILL, KEYS, LIMITS, missing_as_nan, missing_numbers
from wavefocus.storage.text_file import permission_words, require_regular

BARE_DIMENSION = "This is a netCDF dimension but not a netCDF variable."
"""How netCDF-4 names a dimension that has no values (netCDF-4 format specification, dimensions)."""
_MAX_METADATA_BYTES = 64 << 20
_MIN_HEAP_BYTES = 4096  # of the collections that HDF5 keeps texts in
_MAX_VARIABLE = "WAVEFOCUS_MOST_GIB"
# What rounding may put between two ways of counting samples.
_ROUNDING_SAMPLES = 1e-2


def most_bytes() -> int:
    """Largest number of bytes that is read at once, or declared without being held: 8 GiB unless raised."""
    words = os.environ.get(_MAX_VARIABLE, "")
    try:
        gib = float(words) if words else 8.0
        if not 0 < gib < 1e9:
            raise ValueError
    except ValueError:
        raise InputError(f"{_MAX_VARIABLE} is {words!r}; a number of GiB above 0 is needed") from None
    return int(gib * (1 << 30))


def path_of(item: h5py.Group | h5py.Dataset) -> Path:
    """The file that a group or dataset is in, as it was named when it was opened."""
    return Path(item.file.filename)


def _too_large(dataset: h5py.Dataset, what: str, count: int, held: str = "") -> InputError:
    return InputError(
        f"{path_of(dataset)}: {what} {_size(count)}{held}; at most {_size(most_bytes())} are allowed;"
        f" WAVEFOCUS_MOST_GIB={-(-count // (1 << 30))} raises that"
    )


def _size(count: int) -> str:
    for unit, size in (("TiB", 1 << 40), ("GiB", 1 << 30), ("MiB", 1 << 20)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} bytes"


@contextlib.contextmanager
def opened(path: Path, *, cache_bytes: int = 1 << 20) -> Iterator[h5py.File]:
    """Open a file for reading without locks; whatever HDF5 says about it becomes one sentence.

    Raises InputError: when the file is missing, not a regular file, not HDF5, truncated or damaged.
    """
    require_regular(path)
    try:
        with _opened(path, cache_bytes) as file:
            yield file
    except PermissionError as error:
        raise InputError(f"{path} may not be read{permission_words(path)}") from error
    except (OSError, RuntimeError, KeyError, UnicodeDecodeError) as error:
        complaint = hdf5_complaint(error)
        if path.suffix.lower() == ".toml":
            complaint = "is a TOML file; an HDF5 file, such as a bank, is needed"
        raise InputError(f"{path} {complaint}") from error


def _opened(path: Path, cache_bytes: int) -> h5py.File:
    try:
        return h5py.File(path, "r", locking=False, rdcc_nbytes=cache_bytes)
    except OSError as error:
        if "locking flag" not in str(error):
            raise
        # This process has it open with locks. To another driver of HDF5 it is another file, which needs none.
        return h5py.File(path, "r", driver="stdio", locking=False, rdcc_nbytes=cache_bytes)


@contextlib.contextmanager
def opened_as(path: Path, name: str) -> Iterator[h5py.File]:
    """Open a file of one format for reading, as :func:`opened`, once its texts are checked."""
    with opened(path) as file:
        require_sound_texts(file)
        require_format(file, name)
        yield file


@contextlib.contextmanager
def named(path: Path) -> Iterator[None]:
    """Name the file in errors about its values."""
    try:
        yield
    except InputError as error:
        raise InputError(str(error) if str(path) in str(error) else f"{path}: {error}") from error


def hdf5_complaint(error: Exception) -> str:
    """Put a complaint of HDF5 into words."""
    text = " ".join(str(error).split())
    if "truncated file" in text:
        return "is truncated: it is shorter than its own header says; restore it from a copy"
    if "file signature not found" in text:
        return "is not an HDF5 file"
    return f"is damaged or not readable by HDF5 ({text.strip(chr(39))})"


def plain_dataset(
    file: h5py.File, name: str, *, shape: tuple[int, ...] | None = None, gaps: bool = False, kinds: str = "fiu"
) -> h5py.Dataset:
    """Return a dataset of plain numbers stored in this file.

    name: The dataset's name, as ``"/green"``.
    shape: The shape it must have.
    gaps: Whether values may be missing, as `missing_in` says; fill values are refused otherwise.
    kinds: Kinds of NumPy types that are allowed.

    Raises InputError: when it is packed, missing, linked or stored elsewhere, not numeric or of another shape.
    """

    def _refusal(words: str) -> InputError:
        return InputError(f"{path_of(file)}: {name} {words}")

    dataset = _find(file, name)
    if dataset is None:
        raise InputError(f"{path_of(file)} has no dataset {name}")
    if not isinstance(dataset, h5py.Dataset):
        raise _refusal("is not a dataset")
    properties = dataset.id.get_create_plist()
    if properties.get_external_count() or properties.get_layout() == h5py.h5d.VIRTUAL:
        raise _refusal("keeps its data in other files; only data inside the file itself is read")
    try:
        kind = dataset.dtype.kind
    except TypeError:
        kind = "?"
    if kind not in kinds or dataset.shape is None or dataset.dtype.hasobject:
        raise _refusal("holds no plain numbers; floats or integers are allowed")
    if shape is not None and dataset.shape != shape:
        raise _refusal(f"has shape {dataset.shape}; {shape} is needed")
    if missing_in(dataset, written=True, limits=gaps) and not gaps:
        raise _refusal("has a _FillValue or missing_value; plain values are needed here")
    declared, held = _bytes_of(dataset, dataset.shape), dataset.id.get_storage_size()
    # A dataset may declare so many times what it holds before it counts as hollow; rows to come and compression.
    if declared > most_bytes() and declared > 100 * held:
        raise _too_large(dataset, f"{name} of shape {dataset.shape} declares", declared, f" and holds {_size(held)}")
    if dataset.chunks is not None and (chunk := _bytes_of(dataset, dataset.chunks)) > most_bytes():
        raise _too_large(dataset, f"{name} has chunks of {dataset.chunks}, each", chunk)
    if dataset.chunks is not None and properties.get_nfilters():
        _require_true_chunks(dataset)
    return dataset


def _require_true_chunks(dataset: h5py.Dataset) -> None:
    """Refuse compressed chunks that are larger than what they unfold to: they unfold to more than they declare."""
    declared = _bytes_of(dataset, dataset.chunks)
    largest = max((size for _, size in _stored_pieces(dataset)), default=0)
    # What filters may add to a chunk that does not get smaller.
    if largest > declared + declared // 100 + 4096:
        raise InputError(
            f"{path_of(dataset)}: {dataset.name} has a compressed chunk of {_size(largest)} where {_size(declared)} are"
            " declared; it is not read"
        )


def _stored_pieces(dataset: h5py.Dataset) -> list[tuple[int, int]]:
    """(offset, size) of each piece of a dataset's values in the file."""
    pieces: list[tuple[int, int]] = []
    if dataset.chunks is not None:
        dataset.id.chunk_iter(lambda chunk: pieces.append((int(chunk.byte_offset), int(chunk.size))))
    elif (offset := dataset.id.get_offset()) is not None:
        pieces.append((int(offset), dataset.id.get_storage_size()))
    return pieces


def missing_in(dataset: h5py.Dataset, *, written: bool = False, limits: bool = True) -> tuple[Any, ...]:
    """Stored numbers that stand for missing values; raises InputError where the dataset is packed.

    written: Whether all of it was written, so that the fill value of netCDF's library is a value as any other.
    limits: Whether a range of valid values is refused, or passed over.
    """
    stated = set(dataset.attrs) if limits else set(dataset.attrs) - {*LIMITS}
    attributes = {key: dataset.attrs[key] for key in KEYS if key in stated and holds_attribute(dataset, key)}
    fill = None if written else DEFAULT_FILL.get(dataset.dtype.str[1:])
    if fill is not None and dataset.fillvalue != fill:
        fill = None
    return missing_numbers(attributes, f"{path_of(dataset)}: {dataset.name}" if attributes else "", fill)


def _bytes_of(dataset: h5py.Dataset, shape: tuple[int, ...]) -> int:
    return math.prod(int(extent) for extent in shape) * int(dataset.dtype.itemsize)


def require_rows(dataset: h5py.Dataset) -> None:
    """Refuse a dataset one row of which is more than may be read at once."""
    row = _bytes_of(dataset, dataset.shape[1:])
    if row > most_bytes():
        raise _too_large(dataset, f"each row of {dataset.name} of shape {dataset.shape} takes", row)


def require_whole(dataset: h5py.Dataset) -> None:
    """Refuse a dataset that is more than may be read at once."""
    count = _bytes_of(dataset, dataset.shape)
    if count > most_bytes():
        raise _too_large(dataset, f"{dataset.name} of shape {dataset.shape} takes", count)


def read_whole(dataset: h5py.Dataset) -> NDArray[Any]:
    """Read all of a dataset, unless that is more than may be read at once."""
    require_whole(dataset)
    return np.asarray(dataset[...])


def read_part(dataset: h5py.Dataset, selection: Any, words: str) -> NDArray[Any]:
    """Read part of a dataset; raises InputError with `words`, which name file and part, where HDF5 cannot."""
    try:
        return np.asarray(dataset[selection])
    except (OSError, RuntimeError, ValueError) as error:
        complaint = hdf5_complaint(error) if dataset else "is not readable: the file is closed; open it again"
        raise InputError(f"{words} {complaint}") from error


def has(file: h5py.File, name: str) -> bool:
    """Whether a name exists and may hold values, as a netCDF dimension without a variable does not.

    Raises InputError: it or a part of it is a link to elsewhere.
    """
    found, label = _find(file, name), None
    with contextlib.suppress(InputError):
        label = text(found, "NAME") if isinstance(found, h5py.Dataset) else None
    return found is not None and not (label or "").startswith(BARE_DIMENSION)


def _find(file: h5py.File, name: str) -> object:
    """Return the object of a name, None where there is none, if it is in this file itself."""
    found: object = file
    here = ""
    for part in name.strip("/").split("/"):
        if not isinstance(found, h5py.Group):
            raise InputError(f"{file.filename}: {here} is not a group")
        here += f"/{part}"
        link = found.get(part, getlink=True)
        if link is None:
            return None
        if not isinstance(link, h5py.HardLink):
            raise InputError(
                f"{file.filename}: {here} is a link to elsewhere; only objects inside the file itself are read"
            )
        found = found[part]
    return found


def read_floats(file: h5py.File, name: str, shape: tuple[int, ...] | None = None) -> NDArray[np.float64]:
    """Read a whole dataset as native float64, NaN where values are missing."""
    dataset = plain_dataset(file, name, shape=shape, gaps=True)
    return np.asarray(missing_as_nan(read_whole(dataset), missing_in(dataset)), np.float64)


def read_integers(file: h5py.File, name: str, shape: tuple[int, ...] | None = None) -> NDArray[np.int64]:
    """Read a whole plain dataset of integers as native int64."""
    dataset = plain_dataset(file, name, shape=shape)
    if dataset.dtype.kind == "f":
        raise InputError(f"{path_of(file)}: {name} holds floats; integers are needed")
    return np.asarray(read_whole(dataset), np.int64)


def holds_attribute(item: h5py.File | h5py.Dataset, name: str) -> bool:
    """Whether an attribute is there and not empty; netCDF writes an empty text as an attribute without an extent."""
    attributes = item.attrs
    return name in attributes and attributes.get_id(name).get_space().get_simple_extent_type() != h5py.h5s.NULL


def number(file: h5py.File | h5py.Dataset, name: str, default: float | None = None) -> float:
    """Read a finite number from an attribute of the file or of a dataset."""
    if default is not None and not holds_attribute(file, name):
        return default
    return numbers(file, name, 1)[0]


def numbers(file: h5py.File | h5py.Dataset, name: str, count: int) -> tuple[float, ...]:
    """Read ``count`` finite numbers from an attribute of the file or of a dataset."""
    if not holds_attribute(file, name):
        raise InputError(f"{path_of(file)} has no attribute {name}")
    value = _plain_attribute(file, name)
    if value.dtype.kind not in "fiu" or value.size != count or not np.isfinite(value).all():
        wanted = "a finite number" if count == 1 else f"{count} finite numbers"
        raise InputError(f"{path_of(file)}: attribute {name} is {value.tolist()!r}; {wanted} is needed")
    return tuple(float(item) for item in value.reshape(-1))


def pair(file: h5py.File, name: str) -> tuple[float, float] | None:
    """Read two finite numbers from a root attribute; None when it is absent."""
    if not holds_attribute(file, name):
        return None
    first, second = numbers(file, name, 2)
    return first, second


def text(file: h5py.File | h5py.Dataset, name: str) -> str | None:
    """Read a text from an attribute of the file or of a dataset; None when it is absent."""
    if not holds_attribute(file, name):
        return None
    value = _plain_attribute(file, name)
    item = value.reshape(-1)[0] if value.size == 1 else None
    try:
        if isinstance(item, str):
            return item.encode().decode()  # h5py lets bytes that are not UTF-8 through as surrogates
        if isinstance(item, bytes):
            return item.decode()
    except UnicodeError:
        pass
    raise InputError(f"{path_of(file)}: attribute {name} holds no text; a string is needed")


def _plain_attribute(file: h5py.File | h5py.Dataset, name: str) -> NDArray[np.generic]:
    attributes = file.attrs
    try:
        dtype = attributes.get_id(name).dtype
    except TypeError:
        dtype = np.dtype("V1")
    if dtype.kind not in "fiubSU" and h5py.check_string_dtype(dtype) is None:
        raise InputError(f"{path_of(file)}: attribute {name} holds neither plain numbers nor text")
    return np.asarray(attributes[name])


def require_format(file: h5py.File, name: str, *, may_lack: bool = False) -> None:
    """Refuse another format or version; a file that names none is refused unless it may lack it."""
    found = text(file, "format")
    if found is None:
        if not may_lack:
            raise InputError(f"{path_of(file)} says no format; {name!r} is needed")
        return
    if found != name:
        raise InputError(f"{path_of(file)} has the format {found!r}; {name!r} is needed")
    if (version := number(file, "format_version")) != 1:
        raise InputError(f"{path_of(file)} has {name} version {version:g}; this program reads version 1")


def require_sample_times(file: h5py.File, samples: int, sample_rate_hz: float, start_s: float) -> None:
    """Refuse a file whose `/time_s` contradicts its rate and start; one without `/time_s` is fine."""
    if not has(file, "/time_s"):
        return
    time_s = read_floats(file, "/time_s", (samples,))
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(time_s - (start_s + np.arange(samples) / sample_rate_hz)) * sample_rate_hz
    if not (off <= _ROUNDING_SAMPLES).all():
        sample = int(np.argmax(~(off <= _ROUNDING_SAMPLES)))
        raise InputError(
            f"{path_of(file)}: /time_s has {time_s[sample]:g} s at sample {sample}, and by sample_rate_hz it is at"
            f" {start_s + sample / sample_rate_hz:g} s; they must agree"
        )


def require_sound_texts(file: h5py.File) -> None:
    """Refuse damage to a file's texts before HDF5 meets it; searches all but the datasets' values."""
    values: list[tuple[int, int]] = []

    def note(_: str, found: object) -> None:
        if isinstance(found, h5py.Dataset):
            values.extend(_stored_pieces(found))

    file.visititems(note)
    end, path = 0, path_of(file)
    size = path.stat().st_size
    with path.open("rb") as raw:
        for start, count in [*sorted(values), (size, 0)]:
            if _MIN_HEAP_BYTES <= start - end <= _MAX_METADATA_BYTES:
                raw.seek(end)
                content = raw.read(start - end)
                at = content.find(b"GCOL")
                while at >= 0:  # also where no writer would put it: HDF5 follows a damaged address anywhere
                    heap_bytes = int.from_bytes(content[at + 8 : at + 16], "little")
                    if not _heap_is_sound(content[at : at + heap_bytes]):
                        raise InputError(f"{path} is damaged: its texts are not readable; restore a copy")
                    at = content.find(b"GCOL", at + heap_bytes)
            end = max(end, start + count)


def _heap_is_sound(content: bytes) -> bool:
    """Whether the objects of a global heap collection fit into it.

    HDF5 keeps texts there without a checksum, and 2.0 never returns from one whose sizes are wrong (HDF5 file
    format specification 3.0, section III.E).
    """
    size = int.from_bytes(content[8:16], "little")
    if content[:4] != b"GCOL" or size > len(content):
        return False
    at, seen = 16, set[int]()
    while at + 16 <= size:
        index = int.from_bytes(content[at : at + 2], "little")
        length = int.from_bytes(content[at + 8 : at + 16], "little")
        if index == 0:  # what is free, up to the end
            return at + length == size
        at += 16 + (length + 7) // 8 * 8
        if index in seen or at > size:
            return False
        seen.add(index)
    return True
