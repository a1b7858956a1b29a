"""Reading a bank: one this program measured, or one that any program wrote after contract section 2."""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.storage import hdf5_digest, hdf5_reading
from wavefocus.storage.argument_types import Positions, bank_row, bank_rows, checked
from wavefocus.storage.bank.layout import BankHeader, quality_shape, read_check_rows, read_header, read_layout
from wavefocus.storage.bank.ledger import BANK, QUALITY, QUALITY_NAMES, LedgerFigures, figures_of
from wavefocus.storage.bank.notes import Note, read_notes
from wavefocus.storage.durable import Closing
from wavefocus.storage.errors import InputError, OtherLayoutError
from wavefocus.storage.hdf5_writing import sample_times
from wavefocus.storage.labelled import labelled_dataset, rows_on_demand
from wavefocus.storage.ledger.layout import JOURNAL, LEDGER, LedgerLayout, has_ledger
from wavefocus.storage.ledger.reader import DamagedError, LedgerReader, damage_of
from wavefocus.storage.units import drive_of

if TYPE_CHECKING:
    from xarray import Dataset

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]


class ForeignRows:
    """Rows of a bank in any layout that HDF5 reads, converted to native floats; there are no checksums."""

    def __init__(self, path: Path, green: h5py.Dataset, status: NDArray[np.uint8] | None, stack: ExitStack) -> None:
        self._path, self._green, self._status, self._open = path, green, status, stack
        self._packing = hdf5_reading.packing_of(green)
        self.dtype = self._packing.dtype_of(green.dtype)

    def read(self, position: int) -> Float32Array | Float64Array:
        """Green's functions of a position, unpacked by `scale_factor` and `add_offset` where there are any."""
        row = hdf5_reading.read_part(self._green, position, f"{self._path}: /green at position {position}")
        if not self._packing.is_plain:
            return self._packing.unpack(row)
        with np.errstate(over="ignore"):  # a long double beyond float64 becomes an infinity and is refused as such
            return np.ascontiguousarray(row.astype(self.dtype, copy=False))

    def status(self) -> NDArray[np.uint8]:
        """The file's status, or what the rows themselves say; that reads them all, once."""
        if self._status is None:
            found = np.zeros(len(self._green), np.uint8)
            for position in range(len(found)):
                row = self.read(position)
                found[position] = bool(row.any() and np.isfinite(row).all())
            self._status = found
        return self._status.copy()

    def damaged(self) -> tuple[int, ...]:
        """No positions."""
        return ()

    def broken(self) -> NDArray[np.bool_]:
        """False for each position."""
        return np.zeros(len(self._green), bool)

    def close(self) -> None:
        """Close the file."""
        self._open.close()


def read_foreign(file: h5py.File, path: Path, stack: ExitStack) -> tuple[dict[str, Any], ForeignRows]:
    """Read all but the rows of a foreign bank, by the names of `Bank`; the rows take over what `stack` closes.

    Raises InputError: when something needed is missing, or something present has the wrong shape, kind or value.
    """
    hdf5_reading.require_format(file, BANK.name, may_lack=True)
    green = hdf5_reading.plain_dataset(file, "/green", packed=True)
    if green.ndim != 3 or not green.size:
        raise InputError(
            f"{path}: /green has shape {green.shape}; (position, actuator, tap), each 1 or more, is needed"
        )
    hdf5_reading.require_rows(green)
    positions, actuators, taps = green.shape
    rate = hdf5_reading.number(file, "sample_rate_hz")
    if rate <= taps / np.finfo(np.float64).max:
        raise InputError(f"{path}: attribute sample_rate_hz is {rate:g}; a rate above 0 is needed")
    position_mm = hdf5_reading.read_floats(file, "/position_mm", (positions, 2))
    if not np.isfinite(position_mm).all():
        row = int(np.flatnonzero(~np.isfinite(position_mm).all(axis=1))[0])
        raise InputError(f"{path}: /position_mm is not finite at position {row}; both coordinates are needed")
    actuator_mm = np.full((actuators, 2), np.nan)
    if hdf5_reading.has(file, "/actuator_mm"):
        actuator_mm = hdf5_reading.read_floats(file, "/actuator_mm", (actuators, 2))
    time_s = sample_times(taps, rate)
    if hdf5_reading.has(file, "/time_s"):
        hdf5_reading.require_sample_times(file, taps, rate, 0.0)
        time_s = hdf5_reading.read_floats(file, "/time_s", (taps,))
    facts = {
        "sample_rate_hz": rate,
        "taps": taps,
        "position_mm": position_mm,
        "actuator_mm": actuator_mm,
        "time_s": time_s,
        "band_hz": _band(file, path, rate),
        "quality": {name: _quality(file, path, name, positions, actuators) for name in QUALITY_NAMES},
        "rms": np.full((positions, actuators), np.nan),
        **_units(file, green, path),
        "rig_json": hdf5_reading.text(file, "rig"),
        "run_json": hdf5_reading.text(file, "run"),
        "plan_sha256": hdf5_reading.text(file, "plan_sha256"),
        "software": hdf5_reading.text(file, "software"),
        "directions_deg": hdf5_reading.pair(file, "directions_deg"),
        "import_report": hdf5_reading.text(file, "import_report"),
        "check_rows": read_check_rows(file, positions),
    }
    status = _status(file, path, positions)
    return facts, ForeignRows(path, green, status, stack.pop_all())


def _units(file: h5py.File, green: h5py.Dataset, path: Path) -> dict[str, str]:
    unit = hdf5_reading.text(file, "response_unit") or hdf5_reading.text(green, "units") or "m/s/V"
    try:
        return {"response_unit": unit, "drive_unit": drive_of(unit, hdf5_reading.text(file, "drive_unit"))}
    except InputError as error:
        raise InputError(f"{path}: attribute {error}") from None


def _band(file: h5py.File, path: Path, rate: float) -> tuple[float, float] | None:
    if not hdf5_reading.holds_attribute(file, "band_hz"):
        return None
    low, high = hdf5_reading.numbers(file, "band_hz", 2)
    if not 0 <= low < high <= rate / 2:
        raise InputError(f"{path}: attribute band_hz is {low:g} to {high:g}; 0 <= low < high <= {rate / 2:g} is needed")
    return low, high


def _status(file: h5py.File, path: Path, positions: int) -> NDArray[np.uint8] | None:
    if not hdf5_reading.has(file, "/status"):
        return None
    status = hdf5_reading.read_integers(file, "/status", (positions,))
    if ((status < 0) | (status > 31)).any():
        raise InputError(
            f"{path}: /status holds {status.min()} to {status.max()}; sums of 1, 2, 4, 8 and 16 are allowed"
        )
    return status.astype(np.uint8)


def _quality(file: h5py.File, path: Path, name: str, positions: int, actuators: int) -> Float32Array:
    full = quality_shape(name, positions, actuators)
    if not hdf5_reading.has(file, f"/quality/{name}"):
        return np.full(full, 0 if name == "attempts" else np.nan, np.float32)
    dataset = hdf5_reading.plain_dataset(file, f"/quality/{name}")
    packing = hdf5_reading.packing_of(dataset)
    if dataset.shape not in (full, (positions,)):
        raise InputError(f"{path}: /quality/{name} has shape {dataset.shape}; {full} or ({positions},) is needed")
    figures = np.asarray(packing.unpack(hdf5_reading.read_whole(dataset)), np.float32)
    if figures.shape != full:  # one figure per position stands for all its actuators
        figures = np.repeat(figures[:, None], actuators, axis=1)
    return figures


GreenArray = NDArray[np.float32] | NDArray[np.float64]

_FOREIGN_CACHE_BYTES = 64 << 20  # a compressed chunk may hold many positions


@dataclass(frozen=True, slots=True, eq=False)
class Bank(Closing):
    """A bank open for reading; a context manager, made by :func:`open_bank`.

    P positions, N actuators, L taps. What the file does not say is None, or NaN in arrays.

    sample_rate_hz: Rate of the Green's functions in Hz, > 0.
    taps: Length L of each Green's function in samples.
    position_mm, (P, 2): Positions in millimetres.
    actuator_mm, (N, 2): Places of the actuators in millimetres.
    time_s, (L,): Tap times in seconds.
    band_hz: Lowest and highest measured frequency in Hz.
    quality: ``snr_db``, ``residual_db``, ``coherence``, ``peak_v`` (P, N) and ``attempts``, ``moved_mm``,
        ``reference_db``, ``leak_db`` (P,); NaN (attempts 0) where the file does not say.
    rms, (P, N): Root mean square over the taps of each Green's function, float64, as computed when the position was
        committed and covered by its checksum; NaN in rows that are not measured or silent, of an older version, or
        foreign.
    response_unit, drive_unit: Unit of the Green's functions, ``"m/s/V"`` where the file names none, and of the drive:
        where the file names none, what `response_unit` is divided by (N of ``"m/s/N"``), else ``"V"``.
    rig_json, run_json: The validated configuration as JSON text.
    plan_sha256: Hash of all that a resume must not change.
    software: Program and version that made the bank.
    directions_deg: Directions of force and oscillation in the plane, from x towards y.
    rows: Where the rows come from.
    notes: Dated notes that people have added, oldest first.
    unknown_attributes: Names of root attributes of a bank of this program that it does not write.
    inter_channel_delay_s: How much later the response was sampled than the reference, in s, as the recorder stated it
        when the bank was begun; None where the configuration says so.
    origins: JSON text: which banks rows were taken over from; None where all were measured into this one.
    check_rows: Positions off the grid that were measured only to judge what is interpolated between it.
    """

    path: Path
    sample_rate_hz: float
    taps: int
    position_mm: Float64Array
    actuator_mm: Float64Array
    time_s: Float64Array
    band_hz: tuple[float, float] | None
    quality: dict[str, Float32Array]
    rms: Float64Array
    response_unit: str
    drive_unit: str
    rig_json: str | None
    run_json: str | None
    plan_sha256: str | None
    software: str | None
    directions_deg: tuple[float, float] | None
    import_report: str | None
    rows: VerifiedRows | CopiedRows | ForeignRows = field(repr=False)
    notes: tuple[Note, ...] = ()
    unknown_attributes: tuple[str, ...] = ()
    inter_channel_delay_s: float | None = None
    origins: str | None = None
    check_rows: tuple[int, ...] = ()

    def __repr__(self) -> str:
        """Its size and the state of its positions, in three lines at most."""
        band = "" if self.band_hz is None else f", {self.band_hz[0]:g} to {self.band_hz[1]:g} Hz"
        return (
            f"Bank({str(self.path)!r}:\n"
            f"  {self.positions} positions, {self.actuators} actuators, {self.taps} taps\n"
            f"  at {self.sample_rate_hz:g} Hz{band}, {self.response_unit}; by {self.software or 'another program'})"
        )

    @property
    def positions(self) -> int:
        """Number P of grid positions."""
        return len(self.position_mm)

    @property
    def actuators(self) -> int:
        """Number N of actuators."""
        return len(self.actuator_mm)

    @property
    def check(self) -> NDArray[np.bool_]:
        """Which positions (P,) are in `check_rows`."""
        return np.isin(np.arange(self.positions), self.check_rows)

    @property
    def import_facts(self) -> dict[str, Any]:
        """`import_report` as an object; empty where the bank was measured here, or the text is not a JSON object."""
        try:
            facts = json.loads(self.import_report or "{}")
        except (ValueError, RecursionError):
            return {}
        return facts if isinstance(facts, dict) else {}

    @property
    def status(self) -> NDArray[np.uint8]:
        """Status bits (P,) as they were when the bank was opened.

        A foreign bank without ``/status`` counts as valid (1) every row with any nonzero sample and no
        infinite one, the others as not measured (0).
        """
        return self.rows.status()

    def green(self, position: int) -> GreenArray:
        """Read one position's Green's functions.

        position: Row of the bank, 0 to P - 1.

        Returns float32 (N, L), or float64 where a foreign bank holds float64 or integers; zeros where it is not
        measured.
        Raises InputError: when there is no such position, its checksum does not hold, or it holds NaN or infinities.
        """
        green = self.rows.read(bank_row(position, self.positions, f"{self.path}: position"))
        if not np.isfinite(green).all():
            actuator = int(np.flatnonzero(~np.isfinite(green).all(axis=1))[0])
            raise InputError(
                f"{self.path}: /green at position {position}, actuator {actuator} holds NaN or infinities;"
                " finite values are needed"
            )
        return green

    @property
    def broken(self) -> NDArray[np.bool_]:
        """Positions (P,) that were measured and whose entry in the ledger is lost; their status reads 0.

        The Green's functions of others are verified as they are read. A foreign bank has none.
        """
        return self.rows.broken()

    def require_sound(self, positions: Positions | None = None) -> None:
        """Raise InputError where the ledger of the positions that are used, by default of all, is damaged."""
        broken = np.flatnonzero(self.broken)
        if positions is not None:
            broken = np.intersect1d(broken, bank_rows(positions, self.positions))
        if len(broken):
            more = f" ({len(broken)} positions are)" if len(broken) > 1 else ""
            raise InputError(damage_of(self.path, BANK, int(broken[0]), more))

    def to_xarray(self) -> Dataset:
        """The bank as an `xarray.Dataset`, named as in the file; rows of ``green`` are read when they are used.

        Dimensions ``position``, ``actuator``, ``time_s`` and ``axis``; the figures of quality are variables of their
        own. The bank must stay open while rows are read. Raises InputError: xarray is not installed, or, when a row is
        read, its checksum does not hold.
        """
        pair = ("position", "actuator")
        green = rows_on_demand((self.positions, self.actuators, self.taps), self.rows.dtype, self.rows.read)
        data = {
            "green": ((*pair, "time_s"), green, {"units": self.response_unit}),
            "rms": (pair, self.rms, {"units": self.response_unit}),
        } | {name: (pair[: part.ndim], part, {"units": QUALITY[name][0]}) for name, part in self.quality.items()}
        coordinates = {
            "position": np.arange(self.positions),
            "actuator": np.arange(self.actuators),
            "time_s": ("time_s", self.time_s, {"units": "s"}),
            "axis": ["x", "y"],
            "position_mm": (("position", "axis"), self.position_mm, {"units": "mm"}),
            "actuator_mm": (("actuator", "axis"), self.actuator_mm, {"units": "mm"}),
            "status": ("position", self.status),
        }
        names = ("sample_rate_hz", "response_unit", "drive_unit", "band_hz", "software")
        return labelled_dataset(data, coordinates, {name: getattr(self, name) for name in names})

    def verify(self) -> tuple[int, ...]:
        """Check every checksum; return the damaged positions (a foreign bank has none)."""
        return self.rows.damaged()

    def close(self) -> None:
        """Close the file."""
        self.rows.close()


@checked
def open_bank(path: str | Path, *, contents: bool = False) -> Bank:
    """Open a bank for reading, without locks, also while a run is on.

    Parameters
    ----------
    path
        An HDF5 file with at least ``/green``, ``/position_mm`` and the attribute ``sample_rate_hz``.
    contents
        Whether to verify `contents_sha256`, which covers all that is not rows, as well as header and ledger.

    Returns
    -------
    Bank
        A context manager. Green's functions are read by ``green(position)``, and their checksum is verified then.

    Raises
    ------
    InputError
        The file is missing, damaged, of another format or version, or holds what the format does not allow.

    Examples
    --------
    >>> import wavefocus as wf
    >>> with wf.open_bank("plate.h5") as bank:
    ...     green = bank.green(7)
    ...     print(green.shape, bank.response_unit, bank.sample_rate_hz)
    (4, 1000) m/s/V 10000.0
    """
    path = Path(path)
    with ExitStack() as stack:
        content = stack.enter_context(hdf5_reading.opened(path, cache_bytes=_FOREIGN_CACHE_BYTES))
        if not has_ledger(content):
            facts, foreign = read_foreign(content, path, stack)
            return Bank(path=path, rows=foreign, notes=read_notes(content), **facts)
        notes, unknown = read_notes(content), hdf5_digest.unknown_attributes(content)
        rows: VerifiedRows | CopiedRows
        try:
            layout = read_layout(content, path, contents=contents)
            header, rows = layout.header, VerifiedRows(path, layout)
        except OtherLayoutError:
            # Copied object by object, or repacked: nothing lies where it did, and every row still has its checksum.
            header = read_header(content, path)
            rows = CopiedRows(content, path, header, stack)
    return Bank(
        path=path,
        sample_rate_hz=header.sample_rate_hz,
        taps=header.taps,
        position_mm=header.position_mm,
        actuator_mm=header.actuator_mm,
        time_s=sample_times(header.taps, header.sample_rate_hz),
        band_hz=header.band_hz,
        quality=rows.figures.quality,
        rms=rows.figures.rms,
        response_unit=header.response_unit,
        drive_unit=header.drive_unit,
        rig_json=header.rig_json or None,
        run_json=header.run_json or None,
        plan_sha256=header.plan_sha256,
        software=header.software,
        directions_deg=header.directions_deg,
        import_report=header.import_report or None,
        rows=rows,
        notes=notes,
        unknown_attributes=unknown,
        inter_channel_delay_s=header.inter_channel_delay_s,
        origins=header.origins or None,
        check_rows=header.check_rows,
    )


class CopiedRows:
    """Rows of a bank of this program that lies otherwise in its file, read by HDF5 and checked against its ledger."""

    dtype = np.dtype(np.float32)

    def __init__(self, content: h5py.File, path: Path, header: BankHeader, stack: ExitStack) -> None:
        self._path, self._shape = path, header.rows
        rows = _bytes_of(content, LEDGER, (header.positions, self._shape.row_bytes))
        journal = _bytes_of(content, JOURNAL, (self._shape.journal_bytes,))
        self._replacing = self._shape.decode_journal(journal)
        if self._replacing is not None and self._replacing.position < header.positions:
            at = self._replacing.position * self._shape.row_bytes
            rows[at : at + self._shape.row_bytes] = self._replacing.row
        self.ledger = self._shape.decode(rows)
        self.figures: LedgerFigures = figures_of(self.ledger.rows, self.ledger.holds, header.actuators)
        measured = hdf5_reading.has(content, "/status")
        noted = _bytes_of(content, "/status", (header.positions,)) if measured else bytes(header.positions)
        self._erased = self.ledger.empty & (np.frombuffer(noted, np.uint8) != 0)
        self._green = hdf5_reading.plain_dataset(content, "/green", shape=(header.positions, *self._shape.dimensions))
        if self._green.dtype != np.float32:
            raise InputError(f"{path}: /green is of type {self._green.dtype}; float32 is needed")
        hdf5_reading.require_rows(self._green)
        self._open = stack.pop_all()

    def status(self) -> NDArray[np.uint8]:
        """Status bits (P,) that the ledger holds."""
        return self.figures.status.copy()

    def read(self, position: int) -> Float32Array:
        """Green's functions of a position; zeros where the ledger holds nothing for it."""
        if self.ledger.empty[position] and not self._erased[position]:
            return np.zeros(self._shape.dimensions, np.float32)
        if self._replacing is not None and self._replacing.position == position:
            values = self._replacing.chunks[0][: self._shape.data_bytes]
        else:
            row = hdf5_reading.read_part(self._green, position, f"{self._path}: /green at position {position}")
            values = np.ascontiguousarray(row, "<f4").tobytes()
        crcs = self.ledger.crcs[position].tolist()
        if not self.ledger.holds[position] or not self._shape.holds(crcs, [values]):
            raise DamagedError(damage_of(self._path, BANK, position))
        return np.frombuffer(values, "<f4").reshape(self._shape.dimensions).astype(np.float32, copy=False)

    def damaged(self) -> tuple[int, ...]:
        """Positions whose checksums do not hold."""
        return tuple(row for row in np.flatnonzero(~self.ledger.empty | self._erased).tolist() if not self._holds(row))

    def broken(self) -> NDArray[np.bool_]:
        """Positions (P,) that were measured and whose ledger row does not hold or is zeros."""
        return np.asarray(self.ledger.damaged | self._erased)

    def close(self) -> None:
        """Close the file."""
        self._open.close()

    def _holds(self, position: int) -> bool:
        try:
            self.read(position)
        except InputError:
            return False
        return True


def _bytes_of(content: h5py.File, name: str, shape: tuple[int, ...]) -> bytearray:
    dataset = hdf5_reading.plain_dataset(content, name, shape=shape)
    return bytearray(np.ascontiguousarray(hdf5_reading.read_whole(dataset), np.uint8).tobytes())


class VerifiedRows(LedgerReader):
    """Rows of a bank of this program, checked against its ledger."""

    dtype = np.dtype(np.float32)

    def __init__(self, path: Path, layout: LedgerLayout) -> None:
        super().__init__(path, layout)
        self.figures: LedgerFigures = figures_of(self.ledger.rows, self.ledger.holds, layout.header.actuators)

    def status(self) -> NDArray[np.uint8]:
        """Status bits (P,) that the ledger held on opening."""
        return self.figures.status.copy()

    def read(self, position: int) -> Float32Array:
        """Green's functions of a position; zeros where the ledger holds nothing for it."""
        shape, chunks = self._shape, self.chunks(position)
        if chunks is None:
            return np.zeros(shape.dimensions, np.float32)
        return np.frombuffer(chunks[0], "<f4").reshape(shape.dimensions).astype(np.float32, copy=False)

    def differing(self) -> NDArray[np.bool_]:
        """Positions (P,) whose ``/status`` or ``/quality`` in the file are not those of the ledger."""
        noted_status = np.frombuffer(self.figure("/status"), np.uint8)
        differs = np.asarray(noted_status != self.figures.status, bool)
        for name in QUALITY_NAMES:
            if f"/quality/{name}" in self._layout.figures:  # else a bank of the first edition
                # Bit by bit, so that NaN is as good as any other value.
                noted = np.frombuffer(self.figure(f"/quality/{name}"), "<u4").reshape(len(differs), -1)
                held = np.ascontiguousarray(self.figures.quality[name], "<f4").view("<u4").reshape(len(differs), -1)
                differs |= (noted != held).any(axis=1)
        return differs
