"""What a bank says about itself."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.bank.ledger import journal_bytes, ledger_row_bytes, round_to_page
from storage.errors import InputError

Float64Array = NDArray[np.float64]

# All HDF5 metadata sits in blocks of this size, away from the pages that are written later.
METADATA_BLOCK = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class BankHeader:
    """What a bank says about itself and what no resume may change.

    Parameters
    ----------
    sample_rate_hz : float
        Rate of the Green's functions in Hz, > 0.
    taps : int
        Length L of each Green's function in samples, >= 1.
    band_hz : tuple of float
        Lowest and highest measured frequency in Hz, 0 <= low < high <= half the rate.
    position_mm : array (P, 2)
        Grid positions in millimetres, finite.
    actuator_mm : array (N, 2)
        Actuator positions in millimetres, NaN where unknown.
    rig_json, run_json : str
        The validated configuration as JSON text, secrets left out.
    plan_sha256 : str
        Hash of all that a resume must not change.
    software : str
        Program and version that made the bank.
    response_unit : str
        Unit of g.
    drive_unit : str
        Unit of the drive.

    Raises
    ------
    InputError
        When a value is outside what is stated here.
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

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sample_rate_hz) and self.sample_rate_hz > 0):
            raise InputError(f"sample_rate_hz is {self.sample_rate_hz}; a rate above 0 is needed")
        if self.taps < 1:
            raise InputError(f"taps is {self.taps}; at least 1 is needed")
        low, high = self.band_hz
        if not 0 <= low < high <= self.sample_rate_hz / 2:
            raise InputError(
                f"band_hz is {low:g} to {high:g}; 0 <= low < high <= {self.sample_rate_hz / 2:g} is needed"
            )
        for name in ("position_mm", "actuator_mm"):
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if array.ndim != 2 or array.shape[1] != 2 or not array.shape[0]:
                raise InputError(f"{name} has shape {array.shape}; one (x, y) row or more is needed")
            object.__setattr__(self, name, array)
        if not np.isfinite(self.position_mm).all():
            raise InputError("position_mm holds values that are not finite; every grid position needs both coordinates")
        for name in ("rig_json", "run_json", "plan_sha256", "software", "response_unit", "drive_unit"):
            if "\0" in getattr(self, name):
                raise InputError(f"{name} holds a zero character; plain text is needed")

    @property
    def positions(self) -> int:
        """Number P of grid positions."""
        return len(self.position_mm)

    @property
    def actuators(self) -> int:
        """Number N of actuators."""
        return len(self.actuator_mm)

    @property
    def chunk_bytes(self) -> int:
        """Bytes of one position's Green's functions."""
        return self.actuators * self.taps * 4

    @property
    def file_bytes(self) -> int:
        """Bytes that a bank of this size takes on the disk, a little rounded up."""
        per_position = round_to_page(self.chunk_bytes) + ledger_row_bytes(self.actuators) + self.actuators * 16 + 256
        return (
            8 * self.taps
            + self.positions * per_position
            + journal_bytes(self.actuators, self.taps)
            + 4 * METADATA_BLOCK
        )

    def checksum(self) -> int:
        """CRC-32 of everything in the header, as kept in the file."""
        words = (
            self.rig_json,
            self.run_json,
            self.plan_sha256,
            self.software,
            self.response_unit,
            self.drive_unit,
        )
        figures = np.array([self.sample_rate_hz, self.taps, *self.band_hz], "<f8")
        crc = zlib.crc32("\0".join(words).encode())
        for array in (
            figures,
            self.position_mm,
            self.actuator_mm,
            np.arange(self.taps) / self.sample_rate_hz,
        ):
            crc = zlib.crc32(array.astype("<f8").tobytes(), crc)
        return crc
