"""Reading a bank: one this program measured, or one that any program wrote after contract section 2."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from storage import hdf5_reading
from storage.bank.foreign import ForeignRows, read_foreign
from storage.bank.layout import read_layout
from storage.bank.ledger import BANK, QUALITY_NAMES, Figures, figures_of
from storage.durable import Closing
from storage.errors import InputError
from storage.hdf5_writing import sample_times
from storage.ledger.layout import LedgerLayout, has_ledger
from storage.ledger.reader import LedgerReader, damage_of

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
GreenArray = NDArray[np.float32] | NDArray[np.float64]

_FOREIGN_CACHE_BYTES = 64 << 20  # a compressed chunk may hold many positions


@dataclass(frozen=True, slots=True, eq=False)
class Bank(Closing):
    """A bank open for reading; a context manager, made by :func:`open_bank`.

    What it says about itself is as of `storage.bank.header.BankHeader`, None where the file does not say, with
    ``"m/s/V"`` and ``"V"`` for units that it does not name.

    time_s, (L,): Tap times in seconds.
    quality: ``snr_db``, ``residual_db``, ``coherence``, ``peak_v`` (P, N) and ``attempts``, ``moved_mm``,
        ``reference_db`` (P,); NaN (attempts 0) where the file does not say.
    rms, (P, N): Root mean square over the taps of each Green's function, float64, as computed when the position was
        committed and covered by its checksum; NaN in rows that are not measured or silent, of an older version, or
        foreign.
    rows: Where the rows come from.
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
    rows: BankRows | ForeignRows = field(repr=False)

    @property
    def positions(self) -> int:
        """Number P of grid positions."""
        return len(self.position_mm)

    @property
    def actuators(self) -> int:
        """Number N of actuators."""
        return len(self.actuator_mm)

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
        if not 0 <= position < self.positions:
            raise InputError(f"position {position} is not in bank {self.path}; 0 to {self.positions - 1} are")
        green = self.rows.read(int(position))
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

    def require_sound(self, positions: Sequence[int] | None = None) -> None:
        """Raise InputError where the ledger of the positions that are used, by default of all, is damaged."""
        broken = np.flatnonzero(self.broken)
        if positions is not None:
            broken = np.intersect1d(broken, positions)
        if len(broken):
            more = f" ({len(broken)} positions are)" if len(broken) > 1 else ""
            raise InputError(damage_of(self.path, BANK, int(broken[0]), more))

    def verify(self) -> tuple[int, ...]:
        """Check every checksum; return the damaged positions (a foreign bank has none)."""
        return self.rows.damaged()

    def close(self) -> None:
        """Close the file."""
        self.rows.close()


def open_bank(path: str | Path, *, contents: bool = False) -> Bank:
    """Open a bank for reading, without locks, also while a run is on.

    path: An HDF5 file with at least ``/green``, ``/position_mm`` and the attribute ``sample_rate_hz``.
    contents: Whether to verify `contents_sha256`, which covers all that is not rows, as well as header and ledger.

    Raises InputError: when the file is missing, damaged, of another format or version, or holds what contract section 2
    does not allow.
    """
    path = Path(path)
    with ExitStack() as stack:
        content = stack.enter_context(hdf5_reading.opened(path, cache_bytes=_FOREIGN_CACHE_BYTES))
        if not has_ledger(content):
            facts, foreign = read_foreign(content, path, stack)
            return Bank(path=path, rows=foreign, **facts)
        layout = read_layout(content, path, contents=contents)
    header, rows = layout.header, BankRows(path, layout)
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
        rig_json=header.rig_json,
        run_json=header.run_json,
        plan_sha256=header.plan_sha256,
        software=header.software,
        directions_deg=header.directions_deg,
        rows=rows,
    )


class BankRows(LedgerReader):
    """Rows of a bank of this program, checked against its ledger."""

    def __init__(self, path: Path, layout: LedgerLayout) -> None:
        super().__init__(path, layout)
        self.figures: Figures = figures_of(self.ledger.rows, self.ledger.holds, layout.header.actuators)

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
