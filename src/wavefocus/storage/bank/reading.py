"""Reading a bank: one this program measured, or one that any program wrote (`wavefocus.storage.bank.foreign`).

Which banks its rows were taken over from is stated here, too.
"""

from __future__ import annotations

import json
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.storage import hdf5_digest, hdf5_reading
from wavefocus.storage.argument_types import Positions, bank_row, bank_rows, checked
from wavefocus.storage.bank.foreign import ForeignRows, read_foreign
from wavefocus.storage.bank.layout import BankHeader, read_header, read_layout
from wavefocus.storage.bank.ledger import BANK, LedgerFigures, figures_of
from wavefocus.storage.bank.notes import Note, read_notes
from wavefocus.storage.durable import Closing
from wavefocus.storage.errors import InputError, OtherLayoutError
from wavefocus.storage.hdf5_writing import sample_times
from wavefocus.storage.ledger.layout import JOURNAL, LEDGER, LedgerLayout, OnGrid, has_ledger
from wavefocus.storage.ledger.reader import LedgerReader, damage_of

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]


GreenArray = NDArray[np.float32] | NDArray[np.float64]

_FOREIGN_CACHE_BYTES = 64 << 20  # a compressed chunk may hold many positions


@dataclass(frozen=True, slots=True, eq=False)
class Bank(Closing, OnGrid):
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
    rows: LedgerRows | ForeignRows = field(repr=False)
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
        try:
            layout = read_layout(content, path, contents=contents)
            header, rows = layout.header, LedgerRows(path, layout)
        except OtherLayoutError:
            # Copied object by object, or repacked: nothing lies where it did, and every row still has its checksum.
            header = read_header(content, path)
            copied = _CopiedFile(content, path, header, stack)
            rows = LedgerRows(path, copied.layout, copied)
    stated: dict[str, Any] = {name: getattr(header, name) for name in _STATED}
    stated |= {name: getattr(header, name) or None for name in ("rig_json", "run_json", "import_report", "origins")}
    return Bank(
        path=path, rows=rows, time_s=sample_times(header.taps, header.sample_rate_hz), quality=rows.figures.quality,
        rms=rows.figures.rms, notes=notes, unknown_attributes=unknown, **stated,
    )  # fmt: skip


_STATED = (
    "sample_rate_hz", "taps", "position_mm", "actuator_mm", "band_hz", "response_unit", "drive_unit", "plan_sha256",
    "software", "directions_deg", "inter_channel_delay_s", "check_rows",
)  # fmt: skip
"""What `Bank` takes from the header as it is."""


class LedgerRows(LedgerReader):
    """Rows of a bank of this program, checked against its ledger.

    is_copied: Whether the bank lies otherwise in its file than this program laid it out.
    """

    dtype = np.dtype(np.float32)

    def __init__(self, path: Path, layout: LedgerLayout, file: _CopiedFile | None = None) -> None:
        super().__init__(path, layout, file)
        self.is_copied = file is not None
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


class _CopiedFile(Closing):
    """The datasets of a bank that was copied object by object as one file; HDF5 reads them.

    Ledger, journal, status where there is one, rows one after the other.
    """

    def __init__(self, content: h5py.File, path: Path, header: BankHeader, stack: ExitStack) -> None:
        self._path, self._shape, count = path, header.rows, header.positions
        ledger = _bytes_of(content, LEDGER, (count, self._shape.row_bytes))
        journal = _bytes_of(content, JOURNAL, (self._shape.journal_bytes,))
        status = _bytes_of(content, "/status", (count,)) if hdf5_reading.has(content, "/status") else bytearray()
        self._head = ledger + journal + status
        self._green = hdf5_reading.plain_dataset(content, "/green", shape=(count, *self._shape.dimensions))
        if self._green.dtype != np.float32:
            raise InputError(f"{path}: /green is of type {self._green.dtype}; float32 is needed")
        hdf5_reading.require_rows(self._green)
        rows_at = len(self._head) + self._shape.data_bytes * np.arange(count)[None]
        figures = {"/status": (len(ledger) + len(journal), 1)} if status else {}
        self.layout = LedgerLayout(header, self._shape, rows_at, 0, len(ledger), figures)
        self._open = stack.pop_all()

    def read(self, offset: int, size: int) -> bytearray:
        """Bytes of what comes before the rows, or those of a row."""
        if offset < len(self._head):
            return self._head[offset : offset + size]
        position = (offset - len(self._head)) // self._shape.data_bytes
        row = hdf5_reading.read_part(self._green, position, f"{self._path}: /green at position {position}")
        return bytearray(np.ascontiguousarray(row, "<f4").tobytes())

    def read_into(self, offset: int, buffer: memoryview) -> None:
        """Fill a buffer of a row's size."""
        buffer[:] = self.read(offset, len(buffer))

    def close(self) -> None:
        """Close the file."""
        self._open.close()


def _bytes_of(content: h5py.File, name: str, shape: tuple[int, ...]) -> bytearray:
    dataset = hdf5_reading.plain_dataset(content, name, shape=shape)
    return bytearray(np.ascontiguousarray(hdf5_reading.read_whole(dataset), np.uint8).tobytes())


@dataclass(frozen=True, slots=True)
class Origin:
    """Which bank rows were taken over from, as the bank's attribute `origins` states it.

    bank: File name of the bank.
    plan_sha256: Its plan.
    software: Program and version that made it.
    rows: Rows of the new bank, as ``"0-371"``.
    """

    bank: str
    plan_sha256: str
    software: str
    rows: str


def origins_of(bank: Bank) -> tuple[Origin, ...]:
    """Where the rows of a bank come from that it did not measure itself; empty where it has none."""
    try:
        held = json.loads(bank.origins or "[]")
        return tuple(Origin(**{key: str(origin[key]) for key in Origin.__slots__}) for origin in held)
    except (ValueError, TypeError, KeyError, RecursionError):
        raise InputError(f"{bank.path}: attribute origins is not as this program writes it") from None
