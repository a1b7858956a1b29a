"""Banks that any program wrote: `/green`, `/position_mm` and `sample_rate_hz`, each fact held against sense."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.storage import hdf5_reading
from wavefocus.storage.bank.layout import quality_shape, read_check_rows
from wavefocus.storage.bank.ledger import BANK, QUALITY_NAMES
from wavefocus.storage.errors import InputError
from wavefocus.storage.hdf5_writing import sample_times
from wavefocus.storage.missing import missing_as_nan
from wavefocus.storage.units import drive_of, require_meant_rate, require_unit

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]

_FAR = 1e20
"""A row whose peak is 400 dB from the usual one was not measured (IEEE 754: single precision spans 1,500 dB)."""


class ForeignRows:
    """Rows of a bank in any layout that HDF5 reads, converted to native floats; there are no checksums."""

    def __init__(self, path: Path, green: h5py.Dataset, status: NDArray[np.uint8] | None, stack: ExitStack) -> None:
        self._path, self._green, self._status, self._open = path, green, status, stack
        self._missing = hdf5_reading.missing_in(green)

    def read(self, position: int) -> Float32Array | Float64Array:
        """Green's functions of a position, NaN where values are missing."""
        row = hdf5_reading.read_part(self._green, position, f"{self._path}: /green at position {position}")
        return missing_as_nan(row, self._missing)

    def status(self) -> NDArray[np.uint8]:
        """The file's status, or what the rows themselves say; that reads them all, once."""
        if self._status is None:
            rows = (self.read(position) for position in range(len(self._green)))
            peak = np.array([float(np.abs(row).max()) for row in rows])
            usual = np.median(peak[np.isfinite(peak) & (peak > 0)]) if (np.isfinite(peak) & (peak > 0)).any() else 1.0
            self._status = ((peak > usual / _FAR) & (peak < usual * _FAR)).astype(np.uint8)
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
    green = hdf5_reading.plain_dataset(file, "/green", gaps=True)
    if green.ndim != 3 or not green.size:
        raise InputError(
            f"{path}: /green has shape {green.shape}; (position, actuator, tap), each 1 or more, is needed"
        )
    hdf5_reading.require_rows(green)
    positions, actuators, taps = green.shape
    rate = hdf5_reading.number(file, "sample_rate_hz")
    require_meant_rate(rate, str(path))
    for name in ("position_mm", "actuator_mm", "time_s"):
        if hdf5_reading.has(file, f"/{name}"):
            require_unit(path, name, hdf5_reading.text(file[name], "units") or "")
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
    if dataset.shape not in (full, (positions,)):
        raise InputError(f"{path}: /quality/{name} has shape {dataset.shape}; {full} or ({positions},) is needed")
    missing = hdf5_reading.missing_in(dataset, limits=False)
    figures = np.asarray(missing_as_nan(hdf5_reading.read_whole(dataset), missing), np.float32)
    if figures.shape != full:  # one figure per position stands for all its actuators
        figures = np.repeat(figures[:, None], actuators, axis=1)
    return figures
