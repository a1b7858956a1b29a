"""The bank file as HDF5 has it, docs/reference/files.md: its header, and where everything lies."""

import json
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.storage import hdf5_digest, hdf5_reading
from wavefocus.storage.bank.ledger import (
    BANK,
    FIRST_QUALITY_NAMES,
    LATER_QUALITY_NAMES,
    QUALITY,
    QUALITY_NAMES,
    bank_row_shape,
)
from wavefocus.storage.errors import InputError, OtherLayoutError
from wavefocus.storage.hdf5_writing import (
    METADATA_BLOCK,
    attach,
    bare_dimension,
    dimension_scale,
    filled,
    reserved,
    sample_times,
)
from wavefocus.storage.ledger.layout import (
    LedgerLayout,
    OnGrid,
    create_file,
    find_layout,
    later_datasets,
    lay_out_data,
    lay_out_ledger,
    offsets_crc,
    require_checksum,
    require_header,
    require_ledger,
    write_attributes,
)
from wavefocus.storage.ledger.pages import RowShape

Float64Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class BankHeader(OnGrid):
    """What a bank says about itself and what no resume may change; out of range, InputError.

    sample_rate_hz: Rate of the Green's functions in Hz, > 0.
    taps: Length L of each Green's function in samples, >= 1.
    band_hz: Lowest and highest measured frequency in Hz, 0 <= low < high <= half the rate.
    position_mm, (P, 2): Grid positions in millimetres, finite.
    actuator_mm, (N, 2): Actuator positions in millimetres, NaN where unknown.
    rig_json, run_json: The validated configuration as JSON text, secrets left out.
    plan_sha256: Hash of all that a resume must not change.
    software: Program and version that made the bank.
    response_unit, drive_unit: Unit of g, and of the drive.
    directions_deg: Directions of force and oscillation in the plane, from x towards y: which elements of Green's tensor
        these are.
    import_report: JSON text about the file that the bank was made from, as `wavefocus.calibration.imports.bank` writes
        it; empty where the bank was measured here.
    inter_channel_delay_s: How much later the response was sampled than the reference, as the recorder stated it when
        the bank was begun; None where the configuration says so.
    origins: JSON text: which banks rows were taken over from, as `wavefocus.storage.bank.reading.Origin` states it;
        empty where all were measured into this one.
    check_rows: Positions off the grid that were measured only to judge what is interpolated between it.
    """

    sample_rate_hz: float
    taps: int
    band_hz: tuple[float, float]
    position_mm: Float64Array
    actuator_mm: Float64Array
    rig_json: str
    run_json: str
    plan_sha256: str
    software: str
    response_unit: str = "m/s/V"
    drive_unit: str = "V"
    directions_deg: tuple[float, float] | None = None
    import_report: str = ""
    inter_channel_delay_s: float | None = None
    check_rows: tuple[int, ...] = ()
    origins: str = ""

    def __post_init__(self) -> None:
        require_header(self)
        if any(not 0 <= row < self.positions for row in self.check_rows):
            raise InputError(f"check_rows is {self.check_rows}; rows from 0 to {self.positions - 1} are allowed")
        if self.taps < 1:
            raise InputError(f"taps is {self.taps}; at least 1 is needed")

    @property
    def rows(self) -> RowShape:
        """Sizes of a position's Green's functions and of its ledger row."""
        return bank_row_shape(self.actuators, self.taps)

    @property
    def file_bytes(self) -> int:
        """Bytes that a bank of this size takes on the disk, a little rounded up."""
        rows = self.rows
        per_position = rows.chunk_bytes + rows.row_bytes + self.actuators * 16 + 256
        return 8 * self.taps + self.positions * per_position + rows.journal_bytes + 4 * METADATA_BLOCK

    def checksum(self) -> int:
        """CRC-32 of everything in the header, as kept in the file."""
        words = (self.rig_json, self.run_json, self.plan_sha256, self.software, self.response_unit, self.drive_unit)
        figures = np.array([self.sample_rate_hz, self.taps, *self.band_hz])
        crc = zlib.crc32("\0".join(words).encode())
        for array in (figures, self.position_mm, self.actuator_mm, sample_times(self.taps, self.sample_rate_hz)):
            crc = zlib.crc32(array.astype("<f8").tobytes(), crc)
        # Nothing is added where there are none, so that banks without them are as they were.
        return zlib.crc32(np.array(self.check_rows, "<i8").tobytes(), crc)


_TEXTS = {
    "rig": "rig_json", "run": "run_json", **{name: name for name in (
        "plan_sha256", "software", "response_unit", "drive_unit", "import_report", "origins"
    )},
}  # fmt: skip
"""Attributes with a text, and the fields of `BankHeader` that they hold."""
_MAY_LACK = ("import_report", "origins")
_NUMBERS = {
    "sample_rate_hz": "f8", "band_hz": "f8", "directions_deg": "f8", "check_rows": "i8", "inter_channel_delay_s": "f8",
}  # fmt: skip
"""Attributes with numbers, and their types."""
_FIRST_FIGURES = ("/status", *(f"/quality/{name}" for name in FIRST_QUALITY_NAMES))


def create_bank(path: str | Path, header: BankHeader) -> LedgerLayout:
    """Make an unmeasured bank with all its space reserved; an existing file is never touched.

    header: What the bank says about itself.

    Raises ExistsError: when the path exists. InputError: when the folder is missing, or the disk is too small; nothing
    is left behind.
    """
    return create_file(Path(path), header, _lay_out)


def quality_shape(name: str, positions: int, actuators: int) -> tuple[int, ...]:
    """Shape of a dataset of ``/quality``."""
    return (positions,) if name in ("attempts", *LATER_QUALITY_NAMES) else (positions, actuators)


def read_layout(file: h5py.File, path: Path, *, contents: bool = True) -> LedgerLayout:
    """Read and verify header and offsets of a bank that this program made, and its other contents where wished.

    Raises InputError: when the file is of another format or version, is not a bank of this program, is truncated or
    damaged.
    """
    require_ledger(file, BANK)
    layout = _find_layout(file, read_header(file, path))
    layout.require_sound(path)
    table = "its address table's"
    require_checksum(file, "layout_crc32", layout.checksum(_FIRST_FIGURES), table, OtherLayoutError)
    if "layout_later_crc32" in file.attrs:  # not in banks of the first edition
        require_checksum(file, "layout_later_crc32", _later_checksum(layout), table, OtherLayoutError)
    if contents:
        hdf5_digest.require_contents(file, later_datasets(layout))
    return layout


def _lay_out(file: h5py.File, header: BankHeader) -> LedgerLayout:
    file.attrs["format"], file.attrs["format_version"] = BANK.name, 1
    write_attributes(file, header, _TEXTS, _NUMBERS, _MAY_LACK)
    count, actuators, taps = header.positions, header.actuators, header.taps
    position = dimension_scale(file, "position", np.arange(count, dtype="<i4"))
    actuator = dimension_scale(file, "actuator", np.arange(actuators, dtype="<i4"))
    time_s = dimension_scale(file, "time_s", sample_times(taps, header.sample_rate_hz), "s")
    axis = file.create_dataset("axis", data=["x", "y"], dtype=h5py.string_dtype(), track_times=False)
    axis.make_scale("axis")
    (green,) = lay_out_data(file, header, [header.response_unit])
    attach(green, position, actuator, time_s)
    attach(filled(file, "/position_mm", header.position_mm, "mm"), position, axis)
    attach(filled(file, "/actuator_mm", header.actuator_mm, "mm"), actuator, axis)
    status = reserved(file, "/status", (count,), "u1")
    describe_status(status)
    attach(status, position)
    for name in QUALITY_NAMES:
        shape = quality_shape(name, count, actuators)
        empty = np.full(shape, 0 if name == "attempts" else np.nan, "<f4")
        attach(filled(file, f"/quality/{name}", empty, QUALITY[name][0]), *(position, actuator)[: len(shape)])
    row_byte = bare_dimension(file, "durability/ledger_byte", header.rows.row_bytes)
    journal_byte = bare_dimension(file, "durability/journal_byte", header.rows.journal_bytes)
    lay_out_ledger(file, header, position, row_byte, journal_byte)
    layout = _find_layout(file, header)
    file.attrs["header_crc32"] = np.uint32(header.checksum())
    file.attrs["layout_crc32"] = np.uint32(layout.checksum(_FIRST_FIGURES))
    file.attrs["layout_later_crc32"] = np.uint32(_later_checksum(layout))
    return layout


def describe_status(status: h5py.Dataset) -> None:
    """Name the bits of a dataset of status, after CF conventions 1.11, section 3.5."""
    status.attrs["flag_masks"] = np.array([1, 2, 4, 8, 16], "u1")
    status.attrs["flag_meanings"] = "valid over_range poor_signal failed disabled"


def _find_layout(file: h5py.File, header: BankHeader) -> LedgerLayout:
    count, actuators = header.positions, header.actuators
    figures: dict[str, tuple[tuple[int, ...], str]] = {"/status": ((count,), "u1")}
    for name in QUALITY_NAMES:
        if name in FIRST_QUALITY_NAMES or hdf5_reading.has(file, f"/quality/{name}"):
            figures[f"/quality/{name}"] = (quality_shape(name, count, actuators), "<f4")
    return find_layout(file, header, figures)


def _later_checksum(layout: LedgerLayout) -> int:
    return offsets_crc([offset for name, (offset, _) in layout.figures.items() if name not in _FIRST_FIGURES])


def read_check_rows(file: h5py.File, positions: int) -> tuple[int, ...]:
    """Rows of attribute ``check_rows``, ascending; none where there is no such attribute."""
    if not hdf5_reading.holds_attribute(file, "check_rows"):
        return ()
    rows = np.asarray(file.attrs["check_rows"])
    if rows.ndim != 1 or rows.dtype.kind not in "iu" or not ((rows >= 0) & (rows < positions)).all():
        path = hdf5_reading.path_of(file)
        raise InputError(f"{path}: attribute check_rows must hold rows from 0 to {positions - 1}")
    return tuple(sorted(set(rows.tolist())))


def read_header(file: h5py.File, path: Path) -> BankHeader:
    """Read and verify what a bank of this program says about itself. Raises InputError: it is damaged."""
    green = hdf5_reading.plain_dataset(file, "/green")
    if green.ndim != 3:
        raise InputError(f"{path}: /green has shape {green.shape}; (position, actuator, tap) is needed")
    positions, actuators, taps = green.shape
    rate = hdf5_reading.number(file, "sample_rate_hz")
    time_s = hdf5_reading.read_floats(file, "/time_s", (taps,))
    low, high = hdf5_reading.numbers(file, "band_hz", 2)
    words = {}
    for name, own in _TEXTS.items():
        found = hdf5_reading.text(file, name)
        if found is None and name not in _MAY_LACK:
            raise InputError(f"{path} has no attribute {name}")
        words[own] = found or ""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        counted = sample_times(taps, rate)
    if not np.array_equal(time_s, counted):
        raise InputError(f"{path} is damaged: /time_s does not count samples at sample_rate_hz; restore a copy")
    with hdf5_reading.named(path):
        header = BankHeader(
            rate,
            taps,
            (low, high),
            hdf5_reading.read_floats(file, "/position_mm", (positions, 2)),
            hdf5_reading.read_floats(file, "/actuator_mm", (actuators, 2)),
            **words,
            directions_deg=hdf5_reading.pair(file, "directions_deg"),
            check_rows=read_check_rows(file, positions),
            inter_channel_delay_s=(
                hdf5_reading.number(file, "inter_channel_delay_s") if "inter_channel_delay_s" in file.attrs else None
            ),
        )
    require_checksum(file, "header_crc32", header.checksum(), "its header's")
    return header


def rows_off_grid(positions: int, check_rows: Sequence[int], run_json: str | None) -> NDArray[np.bool_]:
    """Which positions (P,) are off the grid that was asked for: check positions, and those that a refinement has added.

    On a grid too coarse for a prediction from neighbours, such rows would be taken for near enough.
    """
    off = np.isin(np.arange(positions), check_rows)
    try:
        regular = json.loads(run_json or "{}")["grid"]["regular_positions"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return off
    if isinstance(regular, int):
        off[max(regular, 0) :] = True
    return off
