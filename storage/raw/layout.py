"""The raw file as HDF5 sees it: laid out once, and the table of where everything lies."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from storage import hdf5_digest, hdf5_safety, reserved_hdf5
from storage.bank.ledger import round_to_page
from storage.durable import PAGE
from storage.errors import InputError
from storage.raw.header import RawHeader
from storage.raw.ledger import raw_journal_bytes
from storage.raw.schedule import Schedule
from storage.reserved_hdf5 import filled, reserved

FORMAT = "wavefocus-raw"
VERSION = 1
LEDGER = "/durability/ledger"
JOURNAL = "/durability/journal"
CHANNELS = ("/reference", "/response")
LATER = frozenset({*CHANNELS, LEDGER, JOURNAL})


@dataclass(frozen=True, slots=True, eq=False)
class RawLayout:
    """Where in the file everything lies, in bytes from its start.

    Parameters
    ----------
    header : RawHeader
        The file's header.
    channel_offset : tuple of int64 array, shape (P,)
        Each position's recordings of reference and response.
    ledger_offset, journal_offset : int
        The first byte of each dataset.
    """

    header: RawHeader
    channel_offset: tuple[NDArray[np.int64], NDArray[np.int64]]
    ledger_offset: int
    journal_offset: int

    @property
    def chunk_bytes(self) -> int:
        """Bytes of one channel of one position, padded to whole pages."""
        return round_to_page(self.header.chunk_bytes)

    def extents(self) -> list[tuple[int, int]]:
        """Return (offset, size) of everything that is written after creation."""
        extents = [(int(offset), self.chunk_bytes) for channel in self.channel_offset for offset in channel]
        extents.append((self.ledger_offset, self.header.positions * PAGE))
        extents.append((self.journal_offset, raw_journal_bytes(self.chunk_bytes)))
        return extents

    def checksum(self) -> int:
        """CRC-32 of all offsets and of the header, as kept in the file."""
        offsets = np.array([offset for offset, _ in self.extents()], "<i8").tobytes()
        return zlib.crc32(offsets, zlib.crc32(self.header.identity().encode()))


def lay_out(path: Path, header: RawHeader) -> int:
    """Write the HDF5 skeleton of a raw file to a new path; return the bytes that its pages need."""
    schedule = header.schedule
    with reserved_hdf5.new_file(path) as file:
        _write_attributes(file, header)
        for name in ("actuator", "delay_s", "gain"):
            filled(file, f"/schedule/{name}", getattr(schedule, name), "s" if name == "delay_s" else "1")
        filled(file, "/position_mm", header.position_mm, "mm")
        filled(file, "/actuator_mm", header.actuator_mm, "mm")
        row = (header.records, header.samples)
        for name, volts in zip(CHANNELS, header.volts_per_count, strict=True):
            dataset = reserved(file, name, (header.positions, *row), "<i2", "1", chunk=(1, *row))
            dataset.attrs["volts_per_count"] = np.float64(volts)
        reserved(file, LEDGER, (header.positions, PAGE), "u1", "1")
        reserved(file, JOURNAL, (raw_journal_bytes(round_to_page(header.chunk_bytes)),), "u1", "1")
        layout = _find_offsets(file, header, path)
        file.attrs["layout_crc32"] = np.uint32(layout.checksum())
        file.attrs[hdf5_digest.CONTENTS] = hdf5_digest.contents_sha256(file, LATER)
        reserved_hdf5.note_heaps(file, layout.extents())
        return max(offset + size for offset, size in layout.extents())


def has_raw_ledger(file: h5py.File) -> bool:
    """Tell whether a raw file is of this program's own making."""
    return hdf5_safety.has(file, LEDGER)


def read_raw_layout(file: h5py.File, path: Path) -> RawLayout:
    """Read and verify header and offsets of a raw file that this program made.

    Raises
    ------
    InputError
        When the file is of another format or version, was made by another program, is truncated or damaged.
    """
    reserved_hdf5.require_sound_heaps(file, path)  # before any text is read
    hdf5_digest.require_contents(file, path, LATER)
    header = read_raw_header(file, path)
    if not has_raw_ledger(file):
        raise InputError(f"{path} was made by another program; it can be read, but not recorded into")
    layout = _find_offsets(file, header, path)
    reserved_hdf5.require_apart(layout.extents(), path)
    if layout.checksum() != hdf5_safety.number(file, "layout_crc32", path):
        raise InputError(f"{path} is damaged: the checksum of its header does not hold; restore it from a copy")
    needed = max(offset + size for offset, size in layout.extents())
    if path.stat().st_size < needed:
        raise InputError(f"{path} is truncated: {path.stat().st_size} of {needed} bytes; restore a copy")
    return layout


def read_raw_header(file: h5py.File, path: Path) -> RawHeader:
    """Read what a raw file of any program says about itself.

    Raises
    ------
    InputError
        When something needed is missing, or something present has the wrong shape, kind or value.
    """
    hdf5_safety.require_format(file, path, FORMAT, VERSION)
    reference, response = (hdf5_safety.plain_dataset(file, name, path) for name in CHANNELS)
    if response.ndim != 3 or not response.size:
        raise InputError(
            f"{path}: /response has shape {response.shape}; (position, record, sample), each 1 or more, is needed"
        )
    if reference.shape != response.shape:
        raise InputError(f"{path}: /reference has shape {reference.shape}; that of /response is needed")
    positions, records, samples = response.shape

    def optional(name: str) -> float | None:
        return hdf5_safety.number(file, name, path) if name in file.attrs else None

    def word(name: str, default: str = "") -> str:
        return hdf5_safety.text(file, name, path) or default

    actuator = hdf5_safety.read_integers(file, "/schedule/actuator", path)
    low, high = hdf5_safety.numbers(file, "band_hz", path, 2)
    averages = optional("averages")
    try:
        if actuator.size and not -(2**31) <= actuator.min() <= actuator.max() < 2**16:
            raise InputError(f"/schedule/actuator holds {actuator.min()} to {actuator.max()}; -1 to 65535 are allowed")
        schedule = Schedule(
            actuator.astype(np.int32),
            hdf5_safety.read_floats(file, "/schedule/delay_s", path),
            hdf5_safety.read_floats(file, "/schedule/gain", path),
            hdf5_safety.number(file, "period_s", path, default=0.0),
        )
        if schedule.records != records:
            raise InputError(
                f"/schedule/actuator has {schedule.records} rows; one for each of the {records} records is needed"
            )
        actuator_mm = np.full((schedule.actuators, 2), np.nan)
        if hdf5_safety.has(file, "/actuator_mm"):
            actuator_mm = hdf5_safety.read_floats(file, "/actuator_mm", path, (schedule.actuators, 2))
        return RawHeader(
            sample_rate_hz=hdf5_safety.number(file, "sample_rate_hz", path),
            samples=samples,
            taps=_whole(hdf5_safety.number(file, "taps", path), "taps"),
            band_hz=(low, high),
            schedule=schedule,
            position_mm=hdf5_safety.read_floats(file, "/position_mm", path, (positions, 2)),
            actuator_mm=actuator_mm,
            response_per_volt=hdf5_safety.number(file, "response_per_volt", path),
            response_unit=word("response_unit", "m/s"),
            reference_gain=hdf5_safety.number(file, "reference_gain", path, default=1.0),
            inter_channel_delay_s=hdf5_safety.number(file, "inter_channel_delay_s", path, default=0.0),
            volts_per_count=(_volts_per_count(reference, path), _volts_per_count(response, path)),
            averages=None if averages is None else _whole(averages, "averages"),
            sweep_s=optional("sweep_s"),
            decay_s=optional("decay_s"),
            same_clock=_same_clock(file, path),
            sweep_law=word("sweep_law"),
            rig_json=word("rig"),
            run_json=word("run"),
            plan_sha256=word("plan_sha256"),
            software=word("software"),
        )
    except InputError as error:
        raise InputError(str(error) if str(path) in str(error) else f"{path}: {error}") from error


def _write_attributes(file: h5py.File, header: RawHeader) -> None:
    file.attrs["format"] = FORMAT
    file.attrs["format_version"] = VERSION
    for name in ("sample_rate_hz", "response_per_volt", "reference_gain", "inter_channel_delay_s"):
        file.attrs[name] = np.float64(getattr(header, name))
    file.attrs["taps"] = np.int64(header.taps)
    file.attrs["band_hz"] = np.array(header.band_hz, np.float64)
    file.attrs["period_s"] = np.float64(header.schedule.period_s)
    file.attrs["response_unit"] = header.response_unit
    if header.averages is not None:
        file.attrs["averages"] = np.int64(header.averages)
    for name in ("sweep_s", "decay_s"):
        if getattr(header, name) is not None:
            file.attrs[name] = np.float64(getattr(header, name))
    if header.same_clock:
        file.attrs["same_clock"] = True
    for name, words in (
        ("sweep_law", header.sweep_law),
        ("rig", header.rig_json),
        ("run", header.run_json),
        ("plan_sha256", header.plan_sha256),
        ("software", header.software),
    ):
        if words:
            file.attrs[name] = words


def _same_clock(file: h5py.File, path: Path) -> bool:
    if "same_clock" not in file.attrs:
        return False
    value = np.asarray(file.attrs["same_clock"])
    if value.dtype.kind not in "biu" or value.size != 1 or int(value.reshape(-1)[0]) not in (0, 1):
        raise InputError(f"{path}: same_clock is {value.tolist()!r}; true or false is needed")
    return bool(value.reshape(-1)[0])


def _volts_per_count(dataset: h5py.Dataset, path: Path) -> float:
    if "volts_per_count" not in dataset.attrs:
        return 1.0
    value = np.asarray(dataset.attrs["volts_per_count"])
    if value.dtype.kind not in "fiu" or value.size != 1:
        raise InputError(f"{path}: {dataset.name} has the volts_per_count {value.tolist()!r}; one number is needed")
    return float(value.reshape(-1)[0])


def _whole(value: float, name: str) -> int:
    if value != int(value):
        raise InputError(f"{name} is {value:g}; a whole number is needed")
    return int(value)


def _find_offsets(file: h5py.File, header: RawHeader, path: Path) -> RawLayout:
    channels = []
    for name in CHANNELS:
        dataset = hdf5_safety.plain_dataset(file, name, path)
        if dataset.dtype != np.dtype("<i2") or dataset.chunks != (1, header.records, header.samples):
            raise InputError(f"{path}: {name} is not laid out as this program lays it out; it cannot be recorded into")
        channels.append(reserved_hdf5.row_offsets(file, name, header.chunk_bytes, path))
    journal = raw_journal_bytes(round_to_page(header.chunk_bytes))
    return RawLayout(
        header,
        (channels[0], channels[1]),
        reserved_hdf5.dataset_offset(file, LEDGER, (header.positions, PAGE), "u1", path),
        reserved_hdf5.dataset_offset(file, JOURNAL, (journal,), "u1", path),
    )
