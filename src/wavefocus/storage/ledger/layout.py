"""Where in a ledger file everything lies: made once through HDF5, written and read by offsets from then on."""

import shutil
import zlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.storage import durable, hdf5_digest, hdf5_reading
from wavefocus.storage.argument_types import require_rate
from wavefocus.storage.durable import PAGE
from wavefocus.storage.errors import ExistsError, InputError, OtherLayoutError
from wavefocus.storage.hdf5_writing import attach, created, reserved
from wavefocus.storage.ledger.pages import LedgerFormat, RowShape
from wavefocus.storage.sidecar_files import clear_leftovers, staging_dir

LEDGER = "/durability/ledger"
JOURNAL = "/durability/journal"
_NOT_WRITTEN = "it cannot be written into, restore it from a whole copy"


class OnGrid:
    """What is stated of positions (P, 2) on a surface and actuators (N, 2) about it."""

    __slots__ = ()
    position_mm: NDArray[np.float64]
    actuator_mm: NDArray[np.float64]

    @property
    def positions(self) -> int:
        """Number P of grid positions."""
        return len(self.position_mm)

    @property
    def actuators(self) -> int:
        """Number N of actuators."""
        return len(self.actuator_mm)


@dataclass(frozen=True, slots=True, eq=False)
class LedgerLayout:
    """The table of offsets, in bytes from the start of the file.

    header: What the file says about itself.
    shape: Sizes of a position's data and of its ledger row.
    chunk_offset, (datasets, P): Each position's data in each dataset.
    ledger_offset, journal_offset: The first byte of each.
    figures: (offset, bytes per position) of datasets that follow from the ledger and can be rebuilt from it.
    """

    header: Any
    shape: RowShape
    chunk_offset: NDArray[np.int64]
    ledger_offset: int
    journal_offset: int
    figures: dict[str, tuple[int, int]]

    @property
    def positions(self) -> int:
        """Number of positions."""
        return int(self.chunk_offset.shape[1])

    def extents(self) -> NDArray[np.int64]:
        """Offset and size (n, 2) of everything that is written after creation."""
        count, shape, chunks = self.positions, self.shape, self.chunk_offset.ravel()
        others = [(self.ledger_offset, count * shape.row_bytes), (self.journal_offset, shape.journal_bytes)]
        others += [(offset, count * size) for offset, size in self.figures.values()]
        return np.concatenate([np.column_stack([chunks, np.full(len(chunks), shape.chunk_bytes)]), others])

    def checksum(self, figures: Collection[str], before: int = 0) -> int:
        """CRC-32 of the offsets of chunks, ledger, journal and some figures, as kept in the file."""
        offsets = [*self.chunk_offset.ravel().tolist(), self.ledger_offset, self.journal_offset]
        return offsets_crc(offsets + [offset for name, (offset, _) in self.figures.items() if name in figures], before)

    def row_offset(self, position: int) -> int:
        """First byte of a position's ledger row."""
        return self.ledger_offset + position * self.shape.row_bytes

    @property
    def file_bytes(self) -> int:
        """Smallest size of the file that holds every page written later."""
        return int(self.extents().sum(axis=1).max())

    def require_sound(self, path: Path) -> None:
        """Refuse extents that overlap or are off the page grid, and a file that is too short for them."""
        extents = self.extents()
        starts, ends = np.sort(extents[:, 0]), np.sort(extents.sum(axis=1))
        if (starts % PAGE).any() or starts[0] < PAGE or (starts[1:] < ends[:-1]).any():
            raise OtherLayoutError(
                f"{path}: its datasets overlap or do not start on a page: it is damaged, or was copied object by"
                f" object; " + _NOT_WRITTEN
            )
        if path.stat().st_size < self.file_bytes:
            raise InputError(f"{path} is truncated: {path.stat().st_size} of {self.file_bytes} bytes; restore a copy")


def offsets_crc(offsets: Sequence[int], before: int = 0) -> int:
    """CRC-32 of offsets."""
    return zlib.crc32(np.array(offsets, "<i8").tobytes(), before)


def require_checksum(file: h5py.File, name: str, found: int, what: str, error: type[InputError] = InputError) -> None:
    """Refuse a file whose attribute `name` is another checksum of `what`."""
    if found != hdf5_reading.number(file, name):
        path = hdf5_reading.path_of(file)
        raise error(f"{path} is damaged: {what} checksum does not hold; restore it from a copy")


def write_attributes(
    file: h5py.File, header: Any, texts: Mapping[str, str], numbers: Mapping[str, str], may_lack: Collection[str]
) -> None:
    """Write what a file says about itself.

    texts: Fields of the header that attributes hold as texts, by attribute.
    numbers: Types of fields that are attributes as they are; None and what is empty are left out.
    may_lack: Attributes that are left out where their text is empty.
    """
    for name, own in texts.items():
        if getattr(header, own) or name not in may_lack:
            file.attrs[name] = getattr(header, own)
    for name, kind in numbers.items():
        value = getattr(header, name)
        if value is not None and np.size(value):
            file.attrs[name] = np.array(value, kind)


def lay_out_data(file: h5py.File, header: Any, units: Sequence[str]) -> tuple[h5py.Dataset, ...]:
    """Reserve the datasets of the positions' data; return them."""
    shape = header.rows
    chunk = (1, *shape.dimensions)
    return tuple(
        reserved(file, name, (header.positions, *shape.dimensions), shape.format.dtype, unit, chunk)
        for name, unit in zip(shape.format.datasets, units, strict=True)
    )


def lay_out_ledger(file: h5py.File, header: Any, *scales: h5py.Dataset) -> None:
    """Reserve ledger and journal; `scales` are those of position, ledger byte and journal byte."""
    ledger = reserved(file, LEDGER, (header.positions, header.rows.row_bytes), "u1")
    journal = reserved(file, JOURNAL, (header.rows.journal_bytes,), "u1")
    if scales:
        attach(ledger, *scales[:2])
        attach(journal, scales[2])


def has_ledger(file: h5py.File) -> bool:
    """Whether this program made a file."""
    return "format" in file.attrs and hdf5_reading.has(file, LEDGER)


def require_ledger(file: h5py.File, form: LedgerFormat) -> None:
    """Refuse a file that is of another format or was not made by this program."""
    hdf5_reading.require_sound_texts(file)  # before any text is read
    hdf5_reading.require_format(file, form.name)
    if not has_ledger(file):
        path = hdf5_reading.path_of(file)
        raise InputError(f"{path} was made by another program; it can be read, but not written into")


def find_layout(file: h5py.File, header: Any, figures: dict[str, tuple[tuple[int, ...], str]]) -> LedgerLayout:
    """Find where everything lies.

    header: What the file says about itself.
    figures: Shape and type of the datasets that follow from the ledger.

    Raises InputError: something is missing or laid out otherwise.
    """
    path, shape, count = hdf5_reading.path_of(file), header.rows, header.positions

    def offset(name: str, expected: tuple[int, ...], dtype: str) -> int:
        dataset = hdf5_reading.plain_dataset(file, name, shape=expected)
        found = dataset.id.get_offset()
        if dataset.dtype != np.dtype(dtype) or dataset.chunks or found is None:
            raise OtherLayoutError(f"{path}: {name} is not laid out as this program lays it out; {_NOT_WRITTEN}")
        return int(found)

    return LedgerLayout(
        header,
        shape,
        np.array([_row_offsets(file, name, shape, count) for name in shape.format.datasets]),
        offset(LEDGER, (count, shape.row_bytes), "u1"),
        offset(JOURNAL, (shape.journal_bytes,), "u1"),
        {
            name: (offset(name, form, dtype), int(np.prod(form[1:])) * np.dtype(dtype).itemsize)
            for name, (form, dtype) in figures.items()
        },
    )


def _row_offsets(file: h5py.File, name: str, shape: RowShape, count: int) -> NDArray[np.int64]:
    """Where each position of a dataset lies that has a chunk for each."""
    path = hdf5_reading.path_of(file)
    dataset = hdf5_reading.plain_dataset(file, name, shape=(count, *shape.dimensions))
    if dataset.dtype != np.dtype(shape.format.dtype) or dataset.chunks != (1, *shape.dimensions):
        raise OtherLayoutError(f"{path}: {name} is not laid out as this program lays it out; {_NOT_WRITTEN}")
    chunks = np.full(count, -1, np.int64)

    def note(chunk: h5py.h5d.StoreInfo) -> None:
        if chunk.size == shape.data_bytes and chunk.filter_mask == 0 and chunk.chunk_offset[0] < count:
            chunks[chunk.chunk_offset[0]] = chunk.byte_offset

    dataset.id.chunk_iter(note)
    if dataset.id.get_create_plist().get_nfilters() or (chunks < 0).any():
        raise OtherLayoutError(f"{path} is damaged: {name} lacks rows or is compressed; {_NOT_WRITTEN}")
    return chunks


def later_datasets(layout: LedgerLayout) -> frozenset[str]:
    """Datasets whose values are written after creation and are checked by the ledger."""
    return frozenset({*layout.shape.format.datasets, *layout.figures, LEDGER, JOURNAL})


def create_file(path: Path, header: Any, lay_out: Callable[[h5py.File, Any], LedgerLayout]) -> LedgerLayout:
    """Make a ledger file with all its space reserved, and return where it lies; an existing file is never touched.

    header: What it says about itself.
    lay_out: Writes attributes and datasets and returns where they lie.

    Raises ExistsError: when the path exists. InputError: when the folder is missing, or the disk is too small; nothing
    is left behind.
    """
    clear_leftovers(path.parent, path.name)
    taken = ExistsError(f"{path} exists already; choose another name, or resume it")
    if path.exists():
        raise taken
    if path.is_symlink():
        raise InputError(f"{path} is a symbolic link to {path.readlink()}; name the file itself")
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    _require_space(path, header.file_bytes)
    try:
        with staging_dir(path) as place:
            with created(place.temporary, laid_out_once=True) as file:
                layout = lay_out(file, header)
                hdf5_digest.seal_contents(file, later_datasets(layout))
            with durable.PositionedFile(place.temporary, write=True) as disk:
                disk.reserve(max(-(-disk.size() // PAGE) * PAGE, layout.file_bytes))
                disk.sync()
            place.complete()
            durable.publish_new(place.temporary, path)
            return layout
    except FileExistsError as error:
        raise taken from error
    except InputError:
        raise
    except (OSError, RuntimeError, ValueError) as error:
        _require_space(path, header.file_bytes, error)
        raise InputError(f"{path} cannot be made: {getattr(error, 'strerror', None) or error}") from error


def _require_space(path: Path, needed: int, error: Exception | None = None) -> None:
    free = shutil.disk_usage(path.parent).free
    if free < needed:
        raise InputError(
            f"{path} needs {needed} bytes and its disk has {free} free; make room or use another"
        ) from error


def require_header(header: Any) -> None:
    """Bring the positions of a new header into order, and refuse values that banks and raw files both exclude."""
    require_rate(header.sample_rate_hz)
    low, high = header.band_hz
    if not 0 <= low < high <= header.sample_rate_hz / 2:
        raise InputError(f"band_hz is {low:g} to {high:g}; 0 <= low < high <= {header.sample_rate_hz / 2:g} is needed")
    for name in ("position_mm", "actuator_mm"):
        array = np.ascontiguousarray(getattr(header, name), dtype=np.float64)
        if array.ndim != 2 or array.shape[1] != 2 or not array.shape[0]:
            raise InputError(f"{name} has shape {array.shape}; one (x, y) row or more is needed")
        object.__setattr__(header, name, array)
    if not np.isfinite(header.position_mm).all():
        raise InputError("position_mm holds values that are not finite; every grid position needs both coordinates")
    for field in fields(header):
        value = getattr(header, field.name)
        if isinstance(value, str) and "\0" in value:
            raise InputError(f"{field.name} holds a zero character; plain text is needed")
