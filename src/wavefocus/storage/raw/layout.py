"""The raw file as HDF5 sees it, docs/reference/files.md: laid out once, and where everything lies."""

import zlib
from pathlib import Path

import h5py
import numpy as np

from wavefocus.storage import durable, hdf5_digest, hdf5_reading
from wavefocus.storage.errors import InputError
from wavefocus.storage.hdf5_writing import filled
from wavefocus.storage.ledger.layout import (
    LedgerLayout,
    create_file,
    find_layout,
    later_datasets,
    lay_out_data,
    lay_out_ledger,
    require_checksum,
    require_ledger,
)
from wavefocus.storage.raw.header import RAW, RawHeader, Schedule

LEAK = "/leak_db"
"""Level of the loopback's leak at the look before each position, in dB re the loopback; not in earlier versions."""
_WORDS = {"rig": "rig_json", "run": "run_json", **{name: name for name in ("plan_sha256", "software", "sweep_law")}}


def create_raw(path: str | Path, header: RawHeader, *, open_file: durable.OpenFile = durable.open_file) -> None:
    """Make an empty raw file with all its space reserved; arguments and errors as of `create_bank`."""
    create_file(Path(path), header.file_bytes, lambda file: _lay_out(file, header), open_file)


def read_raw_layout(file: h5py.File, path: Path) -> LedgerLayout:
    """Read and verify header and offsets of a raw file that this program made.

    Raises InputError: when the file is of another format or version, was made by another program, is truncated or
    damaged.
    """
    require_ledger(file, path, RAW)
    layout = _find_layout(file, read_raw_header(file, path), path)
    layout.require_sound(path)
    require_checksum(file, path, "layout_crc32", _checksum(layout), "its header's")
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
            volts_per_count=(_volts_per_count(reference, path), _volts_per_count(response, path)),
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


def _lay_out(file: h5py.File, header: RawHeader) -> LedgerLayout:
    file.attrs["format"] = RAW.name
    file.attrs["format_version"] = 1
    file.attrs["taps"] = np.int64(header.taps)
    file.attrs["band_hz"] = np.array(header.band_hz, np.float64)
    file.attrs["period_s"] = np.float64(header.schedule.period_s)
    file.attrs["response_unit"] = header.response_unit
    if header.averages is not None:
        file.attrs["averages"] = np.int64(header.averages)
    numbers = (
        "sample_rate_hz", "response_per_volt", "reference_gain", "inter_channel_delay_s", "sweep_s", "decay_s"
    )  # fmt: skip
    for name in numbers:
        if getattr(header, name) is not None:
            file.attrs[name] = np.float64(getattr(header, name))
    if header.same_clock:
        file.attrs["same_clock"] = True
    for name, own in _WORDS.items():
        if getattr(header, own):
            file.attrs[name] = getattr(header, own)
    for name, unit in (("actuator", "1"), ("delay_s", "s"), ("gain", "1")):
        filled(file, f"/schedule/{name}", getattr(header.schedule, name), unit)
    filled(file, "/position_mm", header.position_mm, "mm")
    filled(file, "/actuator_mm", header.actuator_mm, "mm")
    channels = lay_out_data(file, header.rows, header.positions, ["1", "1"])
    for dataset, volts in zip(channels, header.volts_per_count, strict=True):
        dataset.attrs["volts_per_count"] = np.float64(volts)
    filled(file, LEAK, np.full(header.positions, np.nan, "<f4"), "dB")
    lay_out_ledger(file, header.rows, header.positions)
    layout = _find_layout(file, header, Path(file.filename))
    file.attrs["layout_crc32"] = np.uint32(_checksum(layout))
    return layout


def _find_layout(file: h5py.File, header: RawHeader, path: Path) -> LedgerLayout:
    figures: dict[str, tuple[tuple[int, ...], str]] = {}
    if hdf5_reading.has(file, LEAK):
        figures[LEAK] = (header.positions,), "<f4"
    return find_layout(file, path, header, header.rows, header.positions, figures)


def _checksum(layout: LedgerLayout) -> int:
    return layout.checksum((), zlib.crc32(layout.header.identity().encode()))
