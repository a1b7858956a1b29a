"""The bank file as HDF5 sees it: laid out once, and the table of where everything lies.

Contract section 2 says what is in the file. HDF5 writes it once, with all space allocated and without
times, so that it never has to be opened for writing through HDF5 again: ``bank_writer`` writes at the
offsets found here.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from storage import hdf5_digest, hdf5_safety, reserved_hdf5
from storage.bank.header import BankHeader
from storage.bank.ledger import (
    FIRST_QUALITY_NAMES,
    LATER_QUALITY_NAMES,
    QUALITY_NAMES,
    journal_bytes,
    ledger_row_bytes,
    round_to_page,
)
from storage.errors import InputError
from storage.reserved_hdf5 import filled, label, reserved

FORMAT = "wavefocus-bank"
VERSION = 1
LEDGER = "/durability/ledger"
JOURNAL = "/durability/journal"
LATER = frozenset({"/green", "/status", LEDGER, JOURNAL, *(f"/quality/{name}" for name in QUALITY_NAMES)})
QUALITY_UNITS = {
    "snr_db": "dB",
    "residual_db": "dB",
    "coherence": "1",
    "peak_v": "V",
    "attempts": "1",
    "moved_mm": "mm",
    "reference_db": "dB",
}
_NETCDF_DIMENSION = "This is a netCDF dimension but not a netCDF variable."


@dataclass(frozen=True, slots=True, eq=False)
class BankLayout:
    """Where in the file everything lies, in bytes from its start.

    Parameters
    ----------
    header : BankHeader
        The bank's header.
    chunk_offset : array (P,)
        Each position's Green's functions.
    ledger_offset, journal_offset, status_offset : int
        The first byte of each dataset.
    quality_offset : dict
        The first byte of each dataset of ``/quality``; a bank of the first edition lacks the later ones.
    """

    header: BankHeader
    chunk_offset: NDArray[np.int64]
    ledger_offset: int
    journal_offset: int
    status_offset: int
    quality_offset: dict[str, int]

    @property
    def file_bytes(self) -> int:
        """Smallest size of the file that holds every page written later."""
        return max(offset + size for offset, size in self.extents())

    def checksum(self) -> int:
        """CRC-32 of all offsets that the first edition had, as kept in the file."""
        return zlib.crc32(np.array([offset for offset, _ in self._first_extents()], "<i8").tobytes())

    def later_checksum(self) -> int:
        """CRC-32 of the other offsets, as kept in the file."""
        return zlib.crc32(np.array([offset for offset, _ in self._later_extents()], "<i8").tobytes())

    def extents(self) -> list[tuple[int, int]]:
        """Return (offset, size) of everything that is written after creation."""
        return self._first_extents() + self._later_extents()

    def _later_extents(self) -> list[tuple[int, int]]:
        count = self.header.positions
        return [(self.quality_offset[name], 4 * count) for name in LATER_QUALITY_NAMES if name in self.quality_offset]

    def _first_extents(self) -> list[tuple[int, int]]:
        header = self.header
        chunk, count = round_to_page(header.chunk_bytes), header.positions
        extents = [(int(offset), chunk) for offset in self.chunk_offset]
        extents.append((self.ledger_offset, count * ledger_row_bytes(header.actuators)))
        extents.append((self.journal_offset, journal_bytes(header.actuators, header.taps)))
        extents.append((self.status_offset, count))
        for name in FIRST_QUALITY_NAMES:
            per_position = 4 if name == "attempts" else 4 * header.actuators
            extents.append((self.quality_offset[name], count * per_position))
        return extents


def lay_out(path: Path, header: BankHeader) -> int:
    """Write the HDF5 skeleton of an unmeasured bank to a new path; return the bytes that its pages need."""
    with reserved_hdf5.new_file(path) as file:
        _write_attributes(file, header)
        scales = _write_scales(file, header)
        _write_datasets(file, header, scales)
        file.attrs["header_crc32"] = np.uint32(header.checksum())
        layout = _find_offsets(file, header, path)
        file.attrs["layout_crc32"] = np.uint32(layout.checksum())
        file.attrs["layout_later_crc32"] = np.uint32(layout.later_checksum())
        file.attrs[hdf5_digest.CONTENTS] = hdf5_digest.contents_sha256(file, LATER)
        reserved_hdf5.note_heaps(file, layout.extents())
        return layout.file_bytes


def quality_shape(name: str, positions: int, actuators: int) -> tuple[int, ...]:
    """Shape of a dataset of ``/quality``."""
    return (positions,) if name in ("attempts", *LATER_QUALITY_NAMES) else (positions, actuators)


def has_ledger(file: h5py.File) -> bool:
    """Tell whether a file is a bank of this program's own making."""
    return "format" in file.attrs and hdf5_safety.has(file, LEDGER)


def read_layout(file: h5py.File, path: Path) -> BankLayout:
    """Read and verify header and offsets of a bank that this program made.

    Raises
    ------
    InputError
        When the file is of another format or version, is no bank of this program, is truncated or damaged.
    """
    reserved_hdf5.require_sound_heaps(file, path)  # before any text is read
    hdf5_safety.require_format(file, path, FORMAT, VERSION)
    if not has_ledger(file):
        raise InputError(f"{path} was made by another program; it can be read, but not measured into")
    for group in ("/", "/quality", "/durability"):
        for name in file[group]:
            hdf5_safety.require_hard_link(file, f"{group}/{name}", path)
    header = _read_header(file, path)
    layout = _find_offsets(file, header, path)
    if header.checksum() != hdf5_safety.number(file, "header_crc32", path):
        raise InputError(f"{path} is damaged: its header's checksum does not hold; restore it from a copy")
    reserved_hdf5.require_apart(layout.extents(), path)
    if layout.checksum() != hdf5_safety.number(file, "layout_crc32", path):
        raise InputError(f"{path} is damaged: its address table's checksum does not hold; restore it from a copy")
    later = "layout_later_crc32" in file.attrs
    if later and layout.later_checksum() != hdf5_safety.number(file, "layout_later_crc32", path):
        raise InputError(f"{path} is damaged: its address table's checksum does not hold; restore it from a copy")
    if path.stat().st_size < layout.file_bytes:
        raise InputError(f"{path} is truncated: {path.stat().st_size} of {layout.file_bytes} bytes; restore a copy")
    return layout


def _write_attributes(file: h5py.File, header: BankHeader) -> None:
    file.attrs["format"] = FORMAT
    file.attrs["format_version"] = VERSION
    file.attrs["sample_rate_hz"] = np.float64(header.sample_rate_hz)
    file.attrs["response_unit"] = header.response_unit
    file.attrs["drive_unit"] = header.drive_unit
    file.attrs["band_hz"] = np.array(header.band_hz, np.float64)
    file.attrs["rig"] = header.rig_json
    file.attrs["run"] = header.run_json
    file.attrs["plan_sha256"] = header.plan_sha256
    file.attrs["software"] = header.software


def _write_scales(file: h5py.File, header: BankHeader) -> dict[str, h5py.Dataset]:
    """Write the dimension scales; two of them are dimensions without values, as netCDF-4 marks them."""
    row, journal = ledger_row_bytes(header.actuators), journal_bytes(header.actuators, header.taps)
    scales = {
        "position": filled(file, "/position", np.arange(header.positions, dtype="<i4")),
        "actuator": filled(file, "/actuator", np.arange(header.actuators, dtype="<i4")),
        "time_s": filled(file, "/time_s", (np.arange(header.taps) / header.sample_rate_hz).astype("<f8"), "s"),
        "axis": file.create_dataset("axis", data=["x", "y"], dtype=h5py.string_dtype(), track_times=False),
    }
    for name, scale in scales.items():
        scale.make_scale(name)
    for name, size in (("ledger_byte", row), ("journal_byte", journal)):
        # Never written and late to be allocated, so it takes no space.
        scales[name] = file.create_dataset(f"durability/{name}", (size,), "u1", track_times=False)
        scales[name].make_scale(f"{_NETCDF_DIMENSION}{size:10d}")
    return scales


def _write_datasets(file: h5py.File, header: BankHeader, scales: dict[str, h5py.Dataset]) -> None:
    count, actuators, taps = header.positions, header.actuators, header.taps
    unit = header.response_unit
    rows = (scales["position"], scales["actuator"])
    green = reserved(file, "/green", (count, actuators, taps), "<f4", unit, chunk=(1, actuators, taps))
    label(green, *rows, scales["time_s"])
    label(filled(file, "/position_mm", header.position_mm, "mm"), scales["position"], scales["axis"])
    label(filled(file, "/actuator_mm", header.actuator_mm, "mm"), scales["actuator"], scales["axis"])
    status = reserved(file, "/status", (count,), "u1", "1")
    status.attrs["flag_masks"] = np.array([1, 2, 4, 8, 16], "u1")  # CF conventions 1.11, section 3.5
    status.attrs["flag_meanings"] = "valid over_range poor_signal failed disabled"
    label(status, scales["position"])
    for name in QUALITY_NAMES:
        shape = quality_shape(name, count, actuators)
        empty = np.full(shape, 0 if name == "attempts" else np.nan, "<f4")
        label(filled(file, f"/quality/{name}", empty, QUALITY_UNITS[name]), *rows[: len(shape)])
    ledger = reserved(file, LEDGER, (count, ledger_row_bytes(actuators)), "u1", "1")
    label(ledger, scales["position"], scales["ledger_byte"])
    journal = reserved(file, JOURNAL, (journal_bytes(actuators, taps),), "u1", "1")
    label(journal, scales["journal_byte"])


def _read_header(file: h5py.File, path: Path) -> BankHeader:
    green = hdf5_safety.plain_dataset(file, "/green", path)
    if green.dtype != np.dtype("<f4") or green.ndim != 3 or green.chunks != (1, *green.shape[1:]):
        raise InputError(f"{path}: /green is not laid out as this program lays it out; it cannot be measured into")
    positions, actuators, taps = green.shape
    rate = hdf5_safety.number(file, "sample_rate_hz", path)
    time_s = hdf5_safety.read_floats(file, "/time_s", path, (taps,))
    low, high = hdf5_safety.numbers(file, "band_hz", path, 2)

    def word(name: str) -> str:
        found = hdf5_safety.text(file, name, path)
        if found is None:
            raise InputError(f"{path} has no attribute {name}")
        return found

    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        counted = np.arange(taps) / rate
    if not np.array_equal(time_s, counted):
        raise InputError(f"{path} is damaged: /time_s does not count samples at sample_rate_hz; restore a copy")
    try:
        return BankHeader(
            sample_rate_hz=rate,
            taps=taps,
            band_hz=(low, high),
            position_mm=hdf5_safety.read_floats(file, "/position_mm", path, (positions, 2)),
            actuator_mm=hdf5_safety.read_floats(file, "/actuator_mm", path, (actuators, 2)),
            rig_json=word("rig"),
            run_json=word("run"),
            plan_sha256=word("plan_sha256"),
            software=word("software"),
            response_unit=word("response_unit"),
            drive_unit=word("drive_unit"),
        )
    except InputError as error:
        raise InputError(str(error) if str(path) in str(error) else f"{path}: {error}") from error


def _find_offsets(file: h5py.File, header: BankHeader, path: Path) -> BankLayout:
    count, actuators = header.positions, header.actuators

    def offset(name: str, shape: tuple[int, ...], dtype: str) -> int:
        return reserved_hdf5.dataset_offset(file, name, shape, dtype, path)

    return BankLayout(
        header=header,
        chunk_offset=reserved_hdf5.row_offsets(file, "/green", header.chunk_bytes, path),
        ledger_offset=offset(LEDGER, (count, ledger_row_bytes(actuators)), "u1"),
        journal_offset=offset(JOURNAL, (journal_bytes(actuators, header.taps),), "u1"),
        status_offset=offset("/status", (count,), "u1"),
        quality_offset={
            name: offset(f"/quality/{name}", quality_shape(name, count, actuators), "<f4")
            for name in QUALITY_NAMES
            if name in FIRST_QUALITY_NAMES or hdf5_safety.has(file, f"/quality/{name}")
        },
    )
