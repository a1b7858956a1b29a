"""What a file of raw recordings says about itself, contract section 3."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from storage.durable import PAGE
from storage.errors import InputError
from storage.hdf5_writing import METADATA_BLOCK
from storage.ledger.layout import require_header
from storage.ledger.pages import LedgerFormat, RowShape
from storage.raw.schedule import Schedule

Float64Array = NDArray[np.float64]
Law = Literal["linear", "exponential"]
LAWS: tuple[Law, ...] = ("linear", "exponential")

RAW = LedgerFormat(
    name="wavefocus-raw",
    kind="raw file",
    datasets=("/reference", "/response"),
    dtype="<i2",
    row_name=b"WFRAWROW",
    journal_name=b"WFRAWREP",
    crc_at=32,
    remedy="record it again",
)

# One position is held in memory at a time, a few times over.
MOST_POSITION_BYTES = 1 << 29


@dataclass(frozen=True, slots=True, eq=False)
class RawHeader:
    """What a raw file says about itself; out of range, InputError.

    sample_rate_hz: Rate of the recordings in Hz, > 0.
    samples: Samples of each record, >= 1.
    taps: Length L of the Green's functions that they are for, 1 to `samples`.
    band_hz: Lowest and highest frequency played in Hz, 0 <= low < high <= half the rate.
    schedule: What plays when.
    position_mm, (P, 2): Grid positions in millimetres, finite.
    actuator_mm, (N, 2): Actuator positions in millimetres, NaN where unknown.
    response_per_volt: Response unit per DAQ volt, not 0.
    response_unit: That unit.
    reference_gain: DAQ volts on the reference channel per volt of drive, > 0.
    inter_channel_delay_s: How much later the response channel is sampled than the reference channel.
    volts_per_count: Volts of one count of (reference, response), > 0.
    averages: Sweeps of a sequential record.
    sweep_s, decay_s: Length of a sweep and of the silence after it in seconds.
    same_clock: Whether one clock played and recorded; then any excitation is allowed.
    sweep_law: "linear", "exponential" or "other" where the file says how the sweeps run, else empty.
    rig_json, run_json, plan_sha256, software: As of `storage.bank.header.BankHeader`; empty where the file does not
        say.
    """

    sample_rate_hz: float
    samples: int
    taps: int
    band_hz: tuple[float, float]
    schedule: Schedule = field(repr=False)
    position_mm: Float64Array = field(repr=False)
    actuator_mm: Float64Array = field(repr=False)
    response_per_volt: float
    response_unit: str = "m/s"
    reference_gain: float = 1.0
    inter_channel_delay_s: float = 0.0
    volts_per_count: tuple[float, float] = (1.0, 1.0)
    averages: int | None = None
    sweep_s: float | None = None
    decay_s: float | None = None
    same_clock: bool = False
    sweep_law: str = ""
    rig_json: str = ""
    run_json: str = ""
    plan_sha256: str = ""
    software: str = ""

    def __post_init__(self) -> None:
        require_header(self)
        self._require_numbers()
        if self.actuators != self.schedule.actuators:
            raise InputError(
                f"actuator_mm has {self.actuators} rows and the schedule plays {self.schedule.actuators} actuators; "
                "one row for each is needed"
            )
        if self.records * self.samples * 4 > MOST_POSITION_BYTES:
            raise InputError(
                f"a position has {self.records} records of {self.samples} samples; "
                f"at most {MOST_POSITION_BYTES // 4} samples in all are read"
            )

    def _require_numbers(self) -> None:
        if self.samples < 1:
            raise InputError(f"records have {self.samples} samples; 1 or more are needed")
        if self.taps != int(self.taps) or not 1 <= self.taps <= self.samples:
            raise InputError(f"taps is {self.taps:g}; 1 to the samples of a record, {self.samples}, is needed")
        if not (np.isfinite(self.response_per_volt) and self.response_per_volt):
            raise InputError(f"response_per_volt is {self.response_per_volt:g}; a finite number, not 0, is needed")
        if not (np.isfinite(self.reference_gain) and self.reference_gain > 0):
            raise InputError(f"reference_gain is {self.reference_gain:g}; a finite number above 0 is needed")
        if not abs(self.inter_channel_delay_s) < self.samples / self.sample_rate_hz:
            raise InputError(f"inter_channel_delay_s is {self.inter_channel_delay_s:g}; less than a record is needed")
        if not all(np.isfinite(one) and one > 0 for one in self.volts_per_count):
            raise InputError(f"volts_per_count is {self.volts_per_count}; finite numbers above 0 are needed")
        if self.averages is not None and (self.averages != int(self.averages) or self.averages < 1):
            raise InputError(f"averages is {self.averages:g}; a whole number of 1 or more is needed")
        if self.sweep_s is not None and not (np.isfinite(self.sweep_s) and self.sweep_s > 0):
            raise InputError(f"sweep_s is {self.sweep_s:g}; a time above 0 is needed")
        if self.decay_s is not None and not (np.isfinite(self.decay_s) and self.decay_s >= 0):
            raise InputError(f"decay_s is {self.decay_s:g}; a time of 0 or more is needed")
        if self.sweep_law not in ("", *LAWS, "other"):
            raise InputError(f"sweep_law is {self.sweep_law!r}; 'linear', 'exponential' or 'other' is needed")

    @property
    def laws(self) -> tuple[Law, ...]:
        """Laws that the sweeps may follow; none where the file says that they follow another."""
        return tuple(law for law in LAWS if self.sweep_law in ("", law))

    @property
    def positions(self) -> int:
        """Number P of grid positions."""
        return len(self.position_mm)

    @property
    def actuators(self) -> int:
        """Number N of actuators."""
        return len(self.actuator_mm)

    @property
    def records(self) -> int:
        """Records of a position."""
        return self.schedule.records

    @property
    def rows(self) -> RowShape:
        """Sizes of a position's recordings and of its ledger row."""
        return RowShape(RAW, (self.records, self.samples), PAGE)

    @property
    def file_bytes(self) -> int:
        """Bytes that a raw file of this size takes on the disk, a little rounded up."""
        rows = self.rows
        return self.positions * (2 * rows.chunk_bytes + PAGE + 512) + rows.journal_bytes + 4 * METADATA_BLOCK

    def identity(self) -> str:
        """SHA-256 of all that must not change between two estimates into one bank."""
        if self.plan_sha256:
            return self.plan_sha256
        facts = [
            self.sample_rate_hz, self.samples, self.taps, self.band_hz, self.response_per_volt, self.response_unit,
            self.reference_gain, self.inter_channel_delay_s, self.volts_per_count, self.averages, self.sweep_s,
            self.decay_s, self.schedule.period_s, self.rig_json, self.run_json,
        ]  # fmt: skip
        if self.same_clock or self.sweep_law:  # files without them keep the identity they had
            facts += [self.same_clock, self.sweep_law]
        digest = hashlib.sha256(json.dumps(facts).encode())
        schedule = self.schedule
        for array in (self.position_mm, self.actuator_mm, schedule.actuator, schedule.delay_s, schedule.gain):
            digest.update(str(array.shape).encode() + array.tobytes())
        return digest.hexdigest()
