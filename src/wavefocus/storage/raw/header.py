"""A file of raw recordings, docs/reference/files.md: its header with the schedule of records, and where all lies."""

import hashlib
import json
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.storage import hdf5_digest, hdf5_reading
from wavefocus.storage.durable import PAGE
from wavefocus.storage.errors import InputError
from wavefocus.storage.hdf5_writing import METADATA_BLOCK, filled
from wavefocus.storage.ledger.layout import (
    LedgerLayout,
    OnGrid,
    create_file,
    find_layout,
    later_datasets,
    lay_out_data,
    lay_out_ledger,
    require_checksum,
    require_header,
    require_ledger,
    write_attributes,
)
from wavefocus.storage.ledger.pages import ROW_HEAD, Bytes, LedgerFormat, RowShape

_Int32Array = NDArray[np.int32]
Float64Array = NDArray[np.float64]

EMPTY = -1


@dataclass(frozen=True, slots=True, eq=False)
class Schedule:
    """Which actuators each record drives, with the base signal how much delayed and how strong.

    Out of range, InputError; also where a record plays nothing or an actuator twice, or where no record plays an
    actuator below the highest.

    actuator, int32 (records, slots): Actuators from 0; -1 is an empty slot.
    delay_s, float64 (records, slots): Delay of each slot against the base signal in seconds on the playback clock, >=
        0.
    gain, float64 (records, slots): Drive volts of each slot per volt of the base signal, not 0.
    period_s: Period of the base signal on the playback clock, which is then already running when a record starts; 0
        where each record begins and ends in silence.
    """

    actuator: _Int32Array
    delay_s: Float64Array
    gain: Float64Array
    period_s: float = 0.0

    def __post_init__(self) -> None:
        kinds: dict[str, type] = {"actuator": np.int32, "delay_s": np.float64, "gain": np.float64}
        for name, kind in kinds.items():
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), kind))
        if self.actuator.ndim != 2 or not self.actuator.size:
            raise InputError(f"/schedule/actuator has shape {self.actuator.shape}; (record, slot) is needed")
        for name in ("delay_s", "gain"):
            if getattr(self, name).shape != self.actuator.shape:
                shape = getattr(self, name).shape
                raise InputError(f"/schedule/{name} has shape {shape}; that of /schedule/actuator is needed")
        if not (np.isfinite(self.period_s) and self.period_s >= 0):
            raise InputError(f"period_s is {self.period_s:g}; 0 or a period in seconds is needed")
        if self.actuator.min() < EMPTY:
            raise InputError(f"/schedule/actuator holds {self.actuator.min()}; actuators from 0, or -1, are needed")
        driven = self.actuator != EMPTY
        if not driven.any(axis=1).all():
            silent = int(np.flatnonzero(~driven.any(axis=1))[0])
            raise InputError(f"/schedule/actuator plays nothing in record {silent}; at least one actuator is needed")
        for record, row in enumerate(self.actuator):
            played, times = np.unique(row[row != EMPTY], return_counts=True)
            if times.max() > 1:
                twice = int(played[times > 1][0])
                raise InputError(f"/schedule/actuator plays actuator {twice} twice in record {record}; once is allowed")
        missing = np.setdiff1d(np.arange(self.actuators), self.actuator[driven])
        if missing.size:
            raise InputError(f"/schedule/actuator never plays actuator {missing[0]}; every one from 0 on is needed")
        delays, gains = self.delay_s[driven], self.gain[driven]
        if not (np.isfinite(delays).all() and delays.min() >= 0):
            raise InputError(f"/schedule/delay_s holds {delays[~(delays >= 0)][:1]}; 0 or more is needed")
        if not (np.isfinite(gains).all() and gains.all()):
            raise InputError("/schedule/gain holds 0 or a value that is not finite; each slot needs a gain")
        if self.period_s and delays.max() >= self.period_s:
            raise InputError(
                f"/schedule/delay_s holds {delays.max():g}; less than period_s = {self.period_s:g} is needed"
            )

    @property
    def records(self) -> int:
        """Records of a position."""
        return len(self.actuator)

    @property
    def actuators(self) -> int:
        """Number of actuators."""
        return int(self.actuator.max()) + 1

    @property
    def is_sequential(self) -> bool:
        """Whether each record plays one actuator, not delayed, with silence around it."""
        driven = self.actuator != EMPTY
        return self.period_s == 0 and bool((driven.sum(axis=1) == 1).all()) and not self.delay_s[driven].any()

    def slots(self, record: int) -> tuple[_Int32Array, Float64Array, Float64Array]:
        """Actuators, delays in seconds and gains of the slots of a record that are not empty."""
        driven = self.actuator[record] != EMPTY
        return self.actuator[record][driven], self.delay_s[record][driven], self.gain[record][driven]


def sequential(actuators: int) -> Schedule:
    """One record per actuator."""
    shape = (actuators, 1)
    return Schedule(np.arange(actuators, dtype=np.int32)[:, None], np.zeros(shape), np.ones(shape))


def staggered(actuators: int, stagger_s: float, groups: int = 1) -> Schedule:
    """All actuators in one record, or in one per group, each a stagger after the one before.

    Actuator k plays in group k modulo `groups`, so that those that are neighbours on the rim sound in
    different records or far apart.

    actuators: How many, >= 1.
    stagger_s: Delay from slot to slot in seconds, > 0.
    groups: Records per position, 1 to `actuators`.

    Raises InputError: a value outside the range above.
    """
    if not 1 <= groups <= actuators:
        raise InputError(f"groups is {groups}; 1 to the number of actuators, {actuators}, is needed")
    if not (np.isfinite(stagger_s) and stagger_s > 0):
        raise InputError(f"stagger_s is {stagger_s:g}; a time above 0 is needed")
    slots = -(-actuators // groups)
    actuator = np.full((groups, slots), EMPTY, dtype=np.int32)
    for index in range(actuators):
        actuator[index % groups, index // groups] = index
    delays = np.tile(stagger_s * np.arange(slots), (groups, 1))
    return Schedule(actuator, delays, np.ones((groups, slots)), slots * stagger_s)


Law = Literal["linear", "exponential"]
_LAWS: tuple[Law, ...] = ("linear", "exponential")

LEAK = "/leak_db"
"""Level of the loopback's leak at the look before each position, in dB re the loopback; not in earlier versions."""
LEAK_AT = ROW_HEAD.size + 8
"""Where a ledger row has it: after the checksums of reference and response."""


def _figures_of(rows: Bytes, holds: NDArray[np.bool_], shape: RowShape) -> dict[str, NDArray[np.float32]]:
    """Levels of the leak; NaN where there are none."""
    pages = np.frombuffer(rows, np.uint8).reshape(-1, shape.row_bytes)
    found = pages[:, LEAK_AT : LEAK_AT + 4].copy().view("<f4")[:, 0]
    return {LEAK: np.where(holds & (found != 0.0), found, np.float32(np.nan)).astype("<f4")}


RAW = LedgerFormat(
    name="wavefocus-raw",
    kind="raw file",
    datasets=("/reference", "/response"),
    dtype="<i2",
    row_name=b"WFRAWROW",
    journal_name=b"WFRAWREP",
    crc_at=32,
    remedy="record it again",
    figures=_figures_of,
)

# One position is held in memory at a time, a few times over.
_MAX_POSITION_BYTES = 1 << 29


@dataclass(frozen=True, slots=True, eq=False)
class RawHeader(OnGrid):
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
    sweep_law: "linear", "exponential" or "other" where the file says how the sweeps run, else empty: linear.
    rig_json, run_json, plan_sha256, software: See `wavefocus.storage.bank.layout.BankHeader`; empty where the file
        does not say.
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
        if self.records * self.samples * 4 > _MAX_POSITION_BYTES:
            raise InputError(
                f"a position has {self.records} records of {self.samples} samples; "
                f"at most {_MAX_POSITION_BYTES // 4} samples in all are read"
            )

    def _require_numbers(self) -> None:
        record_s = self.samples / self.sample_rate_hz
        averages, sweep_s, decay_s = (1 if x is None else x for x in (self.averages, self.sweep_s, self.decay_s))
        for name, holds, wanted in (
            ("samples", self.samples >= 1, "1 or more"),
            ("taps", self.taps == int(self.taps) and 1 <= self.taps <= self.samples, "1 to the samples of a record"),
            ("response_per_volt", 0 < abs(self.response_per_volt) < np.inf, "a finite number, not 0,"),
            ("reference_gain", 0 < self.reference_gain < np.inf, "a finite number above 0"),
            ("inter_channel_delay_s", abs(self.inter_channel_delay_s) < record_s, "less than a record"),
            ("volts_per_count", all(0 < scale < np.inf for scale in self.volts_per_count), "finite numbers above 0"),
            ("averages", averages >= 1 and averages == int(averages), "a whole number of 1 or more"),
            ("sweep_s", 0 < sweep_s < np.inf, "a time above 0"),
            ("decay_s", 0 <= decay_s < np.inf, "a time of 0 or more"),
            ("sweep_law", self.sweep_law in ("", *_LAWS, "other"), "'linear', 'exponential' or 'other'"),
        ):
            if not holds:
                raise InputError(f"{name} is {getattr(self, name)!r}; {wanted} is needed")

    @property
    def law(self) -> Law | None:
        """Law of the sweeps: linear unless the file states another; None where it states "other"."""
        return next((law for law in _LAWS if law == (self.sweep_law or "linear")), None)

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


_NUMBERS = {"taps": "i8", "band_hz": "f8", "averages": "i8", **dict.fromkeys(
    ("sample_rate_hz", "response_per_volt", "reference_gain", "inter_channel_delay_s", "sweep_s", "decay_s"), "f8"
)}  # fmt: skip
_WORDS = {"rig": "rig_json", "run": "run_json", **{name: name for name in ("plan_sha256", "software", "sweep_law")}}


def create_raw(path: str | Path, header: RawHeader) -> LedgerLayout:
    """Make an empty raw file with all its space reserved; arguments and errors as of `create_bank`."""
    return create_file(Path(path), header, _lay_out)


def read_raw_layout(file: h5py.File, path: Path) -> LedgerLayout:
    """Read and verify header and offsets of a raw file that this program made.

    Raises InputError: when the file is of another format or version, was made by another program, is truncated or
    damaged.
    """
    require_ledger(file, RAW)
    layout = _find_layout(file, read_raw_header(file, path))
    layout.require_sound(path)
    require_checksum(file, "layout_crc32", _checksum(layout), "its header's")
    hdf5_digest.require_contents(file, later_datasets(layout))
    return layout


def read_raw_header(file: h5py.File, path: Path) -> RawHeader:
    """Read what a raw file of any program says about itself.

    Raises InputError: when something needed is missing, or something present has the wrong shape, kind or value.
    """
    hdf5_reading.require_format(file, RAW.name)
    reference, response = (hdf5_reading.plain_dataset(file, name) for name in RAW.datasets)
    if response.ndim != 3 or not response.size:
        raise InputError(
            f"{path}: /response has shape {response.shape}; (position, record, sample), each 1 or more, is needed"
        )
    if reference.shape != response.shape:
        raise InputError(f"{path}: /reference has shape {reference.shape}; that of /response is needed")
    positions, records, samples = response.shape

    def number(name: str) -> float | None:
        return hdf5_reading.number(file, name) if name in file.attrs else None

    def whole(name: str) -> int | None:
        value = number(name)
        if value is not None and value != int(value):
            raise InputError(f"{name} is {value:g}; a whole number is needed")
        return None if value is None else int(value)

    with hdf5_reading.named(path):
        low, high = hdf5_reading.numbers(file, "band_hz", 2)
        volts = [hdf5_reading.number(channel, "volts_per_count", default=1.0) for channel in (reference, response)]
        schedule = _read_schedule(file, records)
        actuator_mm = np.full((schedule.actuators, 2), np.nan)
        if hdf5_reading.has(file, "/actuator_mm"):
            actuator_mm = hdf5_reading.read_floats(file, "/actuator_mm", (schedule.actuators, 2))
        taps = whole("taps")
        if taps is None:
            raise InputError(f"{path} has no attribute taps")
        return RawHeader(
            sample_rate_hz=hdf5_reading.number(file, "sample_rate_hz"),
            samples=samples,
            taps=taps,
            band_hz=(low, high),
            schedule=schedule,
            position_mm=hdf5_reading.read_floats(file, "/position_mm", (positions, 2)),
            actuator_mm=actuator_mm,
            response_per_volt=hdf5_reading.number(file, "response_per_volt"),
            response_unit=hdf5_reading.text(file, "response_unit") or "m/s",
            reference_gain=hdf5_reading.number(file, "reference_gain", default=1.0),
            inter_channel_delay_s=hdf5_reading.number(file, "inter_channel_delay_s", default=0.0),
            volts_per_count=(volts[0], volts[1]),
            averages=whole("averages"),
            sweep_s=number("sweep_s"),
            decay_s=number("decay_s"),
            same_clock=_same_clock(file, path),
            **{own: hdf5_reading.text(file, name) or "" for name, own in _WORDS.items()},
        )


def _read_schedule(file: h5py.File, records: int) -> Schedule:
    actuator = hdf5_reading.read_integers(file, "/schedule/actuator")
    if actuator.size and not -(2**31) <= actuator.min() <= actuator.max() < 2**16:
        raise InputError(f"/schedule/actuator holds {actuator.min()} to {actuator.max()}; -1 to 65535 are allowed")
    schedule = Schedule(
        actuator.astype(np.int32),
        hdf5_reading.read_floats(file, "/schedule/delay_s"),
        hdf5_reading.read_floats(file, "/schedule/gain"),
        hdf5_reading.number(file, "period_s", default=0.0),
    )
    if schedule.records != records:
        raise InputError(
            f"/schedule/actuator has {schedule.records} rows; one for each of the {records} records is needed"
        )
    return schedule


def _same_clock(file: h5py.File, path: Path) -> bool:
    value = np.asarray(file.attrs.get("same_clock", False))
    if value.dtype.kind not in "biu" or value.size != 1 or value.item() not in (0, 1):
        raise InputError(f"{path}: same_clock is {value.tolist()!r}; true or false is needed")
    return bool(value.item())


def _lay_out(file: h5py.File, header: RawHeader) -> LedgerLayout:
    file.attrs["format"], file.attrs["format_version"] = RAW.name, 1
    file.attrs["response_unit"] = header.response_unit
    file.attrs["period_s"] = np.float64(header.schedule.period_s)
    write_attributes(file, header, _WORDS, _NUMBERS, _WORDS)
    if header.same_clock:
        file.attrs["same_clock"] = True
    for name, unit in (("actuator", "1"), ("delay_s", "s"), ("gain", "1")):
        filled(file, f"/schedule/{name}", getattr(header.schedule, name), unit)
    filled(file, "/position_mm", header.position_mm, "mm")
    filled(file, "/actuator_mm", header.actuator_mm, "mm")
    channels = lay_out_data(file, header, ["1", "1"])
    for dataset, volts in zip(channels, header.volts_per_count, strict=True):
        dataset.attrs["volts_per_count"] = np.float64(volts)
    filled(file, LEAK, np.full(header.positions, np.nan, "<f4"), "dB")
    lay_out_ledger(file, header)
    layout = _find_layout(file, header)
    file.attrs["layout_crc32"] = np.uint32(_checksum(layout))
    return layout


def _find_layout(file: h5py.File, header: RawHeader) -> LedgerLayout:
    figures: dict[str, tuple[tuple[int, ...], str]] = {}
    if hdf5_reading.has(file, LEAK):
        figures[LEAK] = (header.positions,), "<f4"
    return find_layout(file, header, figures)


def _checksum(layout: LedgerLayout) -> int:
    return layout.checksum((), zlib.crc32(layout.header.identity().encode()))
