"""What a bank says about itself."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.bank.ledger import bank_rows
from storage.errors import InputError
from storage.hdf5_writing import METADATA_BLOCK, sample_times
from storage.ledger.layout import require_header
from storage.ledger.pages import RowShape

Float64Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class BankHeader:
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

    def __post_init__(self) -> None:
        require_header(self)
        if self.taps < 1:
            raise InputError(f"taps is {self.taps}; at least 1 is needed")

    @property
    def positions(self) -> int:
        """Number P of grid positions."""
        return len(self.position_mm)

    @property
    def actuators(self) -> int:
        """Number N of actuators."""
        return len(self.actuator_mm)

    @property
    def rows(self) -> RowShape:
        """Sizes of a position's Green's functions and of its ledger row."""
        return bank_rows(self.actuators, self.taps)

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
        return crc
