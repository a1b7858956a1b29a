"""A bank as SOFA (AES69), convention GeneralFIR-E; conventions with responses or transfer functions are read."""

import re
from contextlib import ExitStack
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.options import ImportOptions
from wavefocus.storage import hdf5_reading
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.exported_rows import ExportedRows, OnProgress
from wavefocus.storage.exchange.measured import (
    Float64Array,
    Measured,
    blocks,
    chosen_direction,
    distinct,
    from_spherical,
    length_unit,
    require_honest,
)
from wavefocus.storage.exchange.netcdf import numbers, open_hdf5, text_attribute
from wavefocus.storage.exchange.places import table_of
from wavefocus.storage.hdf5_writing import attach, bare_dimension, created, filled, reserved
from wavefocus.storage.missing import WithMissing
from wavefocus.storage.output_files import replacement


def write(path: Path, rows: ExportedRows, on_progress: OnProgress | None = None) -> None:
    """Write a SOFA file: measurements are positions, emitters are actuators, the one receiver is the laser's spot.

    Lengths are metres there; the listener stands at the position, the receiver at the listener. Actuators whose place
    is unknown stand at NaN. ``BankPosition`` and ``BankStatus`` hold each measurement's row and status in the bank.
    It is a netCDF-4 file without compression, as AES69 asks for and the common readers read; one row is in memory.
    """
    bank, count = rows.bank, len(rows.row)
    sizes = {"I": 1, "C": 3, "R": 1, "E": bank.actuators, "N": bank.taps, "M": count, "S": 0}
    with replacement(path) as temporary, created(temporary, 8 * count * (bank.actuators * bank.taps + 5)) as file:
        for name, text in _attributes(rows).items():
            _set_text(file, name, text)
        scales = {name: bare_dimension(file, name, size) for name, size in sizes.items()}

        def variable(name: str, dimensions: str, values: Any, **attributes: str) -> None:
            data = filled(file, name, np.asarray(values, np.float64), None)
            attach(data, *(scales[dimension] for dimension in dimensions))
            for attribute, text in attributes.items():
                _set_text(data, attribute, text)

        place = {"Type": "cartesian", "Units": "metre"}
        variable("ListenerPosition", "MC", _metres(rows.position_mm), **place)
        variable("ReceiverPosition", "IC", np.zeros((1, 3)), **place)
        variable("SourcePosition", "IC", np.zeros((1, 3)), **place)
        variable("EmitterPosition", "EC", _metres(bank.actuator_mm), **place)
        variable("Data.SamplingRate", "I", [bank.sample_rate_hz], Units="hertz")
        variable("Data.Delay", "IRE", np.zeros((1, 1, bank.actuators)))
        variable("BankPosition", "M", rows.row)
        variable("BankStatus", "M", rows.status)
        data = reserved(file, "Data.IR", (count, 1, bank.taps, bank.actuators), "<f8", None)
        attach(data, *(scales[dimension] for dimension in "MRNE"))
        for measurement, (_, green) in enumerate(rows.each(on_progress)):
            data[measurement, 0] = green.T


def _attributes(rows: ExportedRows) -> dict[str, str]:
    """Attributes of the whole file; AES69 demands most of them, also where nothing is known."""
    bank, about, now = rows.bank, rows.publication, f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S}"
    band = "unknown" if bank.band_hz is None else f"{bank.band_hz[0]:g} to {bank.band_hz[1]:g} Hz"
    attributes = {
        "Conventions": "SOFA",
        "Version": "2.1",
        "SOFAConventions": "GeneralFIR-E",  # of AES69, for one receiver and many emitters at once
        "SOFAConventionsVersion": "2.0",
        "DataType": "FIR-E",
        "RoomType": "reverberant" if "room" in about else "free field",
        "Title": rows.title,
        "License": about.get("licence", "not stated"),
        "AuthorContact": about.get("people", "not stated"),
        "Organization": about.get("organisation", "not stated"),
        "DateCreated": now,
        "DateModified": now,
        "APIName": "wavefocus",
        "APIVersion": version("wavefocus"),
        "ApplicationName": "wavefocus",
        "ApplicationVersion": version("wavefocus"),
        "Comment": f"Data.IR is in {rows.units[0]}, tap 0 at the drive sample; band {band}; coordinates on the"
        " surface, origin at its centre, x right, y up, seen from the laser"
        + (f"; notes: {about['notes']}" if "notes" in about else ""),
    }
    optional = {"RoomDescription": "room", "DatabaseName": "database", "References": "references"}
    return attributes | {name: about[key] for name, key in optional.items() if key in about}


def _set_text(holder: h5py.File | h5py.Dataset, name: str, text: str) -> None:
    """Set an attribute as netCDF's own library does, the only kind that libmysofa reads: UTF-8 in fixed length."""
    content = text.encode()
    kind = h5py.h5t.C_S1.copy()
    kind.set_size(len(content))
    kind.set_strpad(h5py.h5t.STR_NULLTERM)
    attribute = h5py.h5a.create(holder.id, name.encode(), kind, h5py.h5s.create(h5py.h5s.SCALAR))
    attribute.write(np.array(content, f"S{len(content)}"), kind)


def _metres(points_mm: Float64Array) -> Float64Array:
    return np.column_stack([points_mm / 1e3, np.zeros(len(points_mm))])


_AXES = {"FIR": "mrn", "FIR-E": "mrne", "FIRE": "mren", "TF": "mrn", "TF-E": "mrne"}
_UNIT = re.compile(r"Data\.IR is in ([^,;]+)")


def read(path: Path, options: ImportOptions, stack: ExitStack) -> Measured:
    """Read responses from emitters to receivers.

    Positions are the receivers, where the listener is; actuators the emitters, where the source is. A measurement (M)
    counts positions where the listener moves or turns, actuators where the source does, pairs where both do.
    """
    file = open_hdf5(path, stack)
    data_type = text_attribute(file, "DataType")
    if data_type not in _AXES:
        raise InputError(f"{path}: DataType is {data_type[:40]!r}; allowed are {', '.join(_AXES)}")
    axes, is_spectrum = _AXES[data_type], data_type.startswith("TF")
    datasets = [_needed(file, name, path) for name in (("Data.Real", "Data.Imag") if is_spectrum else ("Data.IR",))]
    shape = datasets[0].shape
    if len(shape) != len(axes) or 0 in shape or any(dataset.shape != shape for dataset in datasets):
        name = "Data.Real" if is_spectrum else "Data.IR"
        raise InputError(f"{path}: {name} has shape {shape}; ({', '.join(axes.upper())}) is needed")
    size = {axis: int(count) for axis, count in zip(axes, shape, strict=True)} | ({} if "e" in axes else {"e": 1})
    listener, listener_varies = _places(file, "Listener", "Receiver", size["r"], size["m"], path)
    source, source_varies = _places(file, "Source", "Emitter", size["e"], size["m"], path)
    read = [
        f"convention {text_attribute(file, 'SOFAConventions')[:40]}, DataType {data_type}: {size['m']} measurements,"
        f" {size['r']} receivers, {size['e']} emitters, {size['n']} samples"
    ]
    receivers = np.arange(size["r"])
    if options.direction or (size["r"] > 1 and np.isnan(listener).any()):
        names = [str(index) for index in range(size["r"])]
        receivers = np.array([chosen_direction(options, names, path)])
        read.append(f"only receiver {receivers[0]}")
        listener = listener[:, receivers]
        if not np.isfinite(listener).all():  # spherical harmonics have no place of their own: the listener's
            centre = _coordinates(file, "ListenerPosition", path)[0][:, None]
            listener = np.broadcast_to(centre, listener.shape)
    role = "positions" if not source_varies else "pairs" if listener_varies else "actuators"
    role = options.measurements or role
    row_of, column_of, position_m, actuator_m = _numbering(role, listener, source)
    read.append(f"measurements count {role}; positions are receivers, actuators are emitters")
    delay = _delay(file, size, path)
    values = _Responses(path, datasets, axes, receivers, delay)
    samples = size["n"] + values.extra
    if delay.any():
        read.append(f"Data.Delay of up to {delay.max():g} samples is part of the responses")
    frequency_hz = rate_hz = None
    if is_spectrum:
        frequency_hz = hdf5_reading.read_floats(file, "/N").reshape(-1)
        if delay.any() or len(frequency_hz) != size["n"]:
            raise InputError(f"{path}: N needs {size['n']} frequencies, and a transfer function no Data.Delay")
    else:
        rates = np.unique(hdf5_reading.read_floats(file, "/Data.SamplingRate"))
        if len(rates) != 1 or not rates[0] > 0:
            raise InputError(f"{path}: Data.SamplingRate is {rates.tolist()[:4]}; one rate above 0 is needed")
        rate_hz = float(rates[0])
    counts = (len(position_m), len(actuator_m))
    if options.places is not None:
        position_m, actuator_m = table_of(options, path, *counts)
    unit = _UNIT.search(text_attribute(file, "Comment"))
    status = _bank_status(file, counts[0]) if role == "positions" and len(receivers) == 1 else None
    return Measured(
        rows=values.in_order() if role == "positions" else values.placed(row_of, column_of, counts),
        shape=(*counts, samples),
        position_m=position_m,
        actuator_m=actuator_m,
        unit=unit[1].strip() if unit else "",
        sample_rate_hz=rate_hz,
        frequency_hz=frequency_hz,
        status=status,
        read=tuple(read),
    )


def _needed(file: h5py.File, name: str, path: Path) -> h5py.Dataset | WithMissing:
    found = numbers(file, name, path)
    if found is None or found.dtype.kind not in "fiu":
        raise InputError(f"{path} has no {name} of real numbers, which a SOFA file of this DataType needs")
    missing = hdf5_reading.missing_in(found)
    return WithMissing(found, missing) if missing else found


def _places(
    file: h5py.File, body: str, part: str, count: int, measurements: int, path: Path
) -> tuple[Float64Array, bool]:
    """Places of receivers (or emitters), which are relative to the listener (or source) and turn with it.

    In metres (M, count, 3), NaN where they are not places; and whether they differ between measurements.
    """
    centre, _ = _coordinates(file, f"{body}Position", path)
    own, is_place = _coordinates(file, f"{part}Position", path)
    view, up = _axes_of(file, body, path)
    if count == 1 and own.shape[0] > 1:  # a convention without an axis for emitters: which one sounds is not said
        own, is_place = own[:1], False
    if own.shape[0] not in (1, count):
        raise InputError(f"{path}: {part}Position has {own.shape[0]} places; {count} are needed")
    for name, table in (("Position", centre), ("View", view), ("Up", up)):
        if len(table) not in (1, measurements):
            raise InputError(f"{path}: {body}{name} has {len(table)} rows; 1 or {measurements} are needed")
    if own.shape[2] not in (1, measurements):
        raise InputError(f"{path}: {part}Position has {own.shape[2]} measurements; 1 or {measurements} are needed")
    rows = max(len(centre), len(view), len(up), own.shape[2])
    placed = np.empty((rows, count, 3))
    for row in range(rows):
        ahead, above = view[row % len(view)], up[row % len(up)]
        turned = own[:, :, row % own.shape[2]] @ np.array([ahead, np.cross(above, ahead), above])
        placed[row] = centre[row % len(centre)] + turned
    varies = bool(rows > 1 and (placed.max(axis=0) - placed.min(axis=0) > 1e-9).any())
    # Emitters that all lie at one unknown place are distinguished only by their number.
    if not is_place or (count > 1 and own.shape[0] == 1):
        return np.full((measurements, count, 3), np.nan), False
    turns = rows > 1 and len(view) > 1 and bool(np.ptp(view, axis=0).any())
    return np.broadcast_to(placed, (measurements, count, 3)), varies or turns


def _coordinates(file: h5py.File, name: str, path: Path) -> tuple[Float64Array, bool]:
    """Places in metres: (rows, 3), or (count, 3, rows) of receivers and emitters; whether they are places at all."""
    values = hdf5_reading.read_floats(file, f"/{name}")
    kind, units = text_attribute(file[name], "Type"), text_attribute(file[name], "Units")
    if not kind and units.strip().lower().startswith("deg"):
        kind = "spherical"
    is_part = name.startswith(("Receiver", "Emitter"))
    if is_part and values.ndim == 2:
        values = values[:, :, None]
    if values.ndim != (3 if is_part else 2) or values.shape[1] != 3:
        raise InputError(f"{path}: {name} has shape {values.shape}; three coordinates are needed")
    if kind == "spherical harmonics":
        return np.zeros_like(values), False
    flat = values.transpose(0, 2, 1).reshape(-1, 3) if is_part else values
    if kind == "spherical":
        flat = from_spherical(flat)
    elif not units.strip():
        units = "metre"  # AES69: the default unit
    if kind != "spherical":
        flat = flat * length_unit(ImportOptions(), path, units.split(",")[0])
    return (flat.reshape(len(values), -1, 3).transpose(0, 2, 1) if is_part else flat), True


def _axes_of(file: h5py.File, body: str, path: Path) -> tuple[Float64Array, Float64Array]:
    """Directions ahead and up, unit vectors (rows, 3), at right angles."""
    vectors = []
    for name, default in (("View", (1.0, 0.0, 0.0)), ("Up", (0.0, 0.0, 1.0))):
        if not hdf5_reading.has(file, f"{body}{name}"):
            vectors.append(np.array([default]))
            continue
        values = hdf5_reading.read_floats(file, f"/{body}{name}")
        if values.ndim != 2 or values.shape[1] != 3:
            raise InputError(f"{path}: {body}{name} has shape {values.shape}; three coordinates are needed")
        holder = file[f"{body}View"] if hdf5_reading.has(file, f"{body}View") else file[f"{body}{name}"]
        is_spherical = text_attribute(file[f"{body}{name}"], "Type") or text_attribute(holder, "Type")
        vectors.append(from_spherical(values) if is_spherical == "spherical" else values)
    ahead, above = vectors
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        across = above - ahead * np.sum(above * ahead, axis=1, keepdims=True)
        above = across / np.linalg.norm(across, axis=1, keepdims=True)
    if not (np.isfinite(ahead).all() and np.isfinite(above).all()):
        raise InputError(f"{path}: {body}View and {body}Up need two directions that differ")
    return ahead, above


def _numbering(
    role: str, listener: Float64Array, source: Float64Array
) -> tuple[NDArray[np.int64], NDArray[np.int64], Float64Array, Float64Array]:
    """Row of each (measurement, receiver), column of each (measurement, emitter), and the places of both."""
    measurements, receivers, emitters = len(listener), listener.shape[1], source.shape[1]
    where, driven = listener.reshape(-1, 3), source.reshape(-1, 3)
    if role == "positions":
        rows, position_m = np.arange(measurements * receivers), where
        columns, actuator_m = np.tile(np.arange(emitters), measurements), source[0]
    elif role == "actuators":
        rows, position_m = np.tile(np.arange(receivers), measurements), listener[0]
        columns, actuator_m = np.arange(measurements * emitters), driven
    else:
        rows, position_m = distinct(where)
        columns, actuator_m = distinct(driven)
    return rows.reshape(measurements, -1), columns.reshape(measurements, -1), position_m, actuator_m


def _delay(file: h5py.File, size: dict[str, int], path: Path) -> Float64Array:
    """Data.Delay in samples, (M, R, E)."""
    full = (size["m"], size["r"], size["e"])
    if not hdf5_reading.has(file, "Data.Delay"):
        return np.zeros(full)
    delay = hdf5_reading.read_floats(file, "/Data.Delay")
    if delay.ndim == 2:
        delay = delay[:, :, None]
    if delay.ndim != 3 or any(count not in (1, most) for count, most in zip(delay.shape, full, strict=True)):
        raise InputError(f"{path}: Data.Delay has shape {delay.shape}; {full}, or 1 in place of a number, is needed")
    if not (np.isfinite(delay).all() and delay.min() >= 0 and delay.max() <= 100 * size["n"] + 1e6):
        raise InputError(f"{path}: Data.Delay is {delay.min():g} to {delay.max():g} samples; 0 or more is needed")
    return np.asarray(np.broadcast_to(delay, full))


def _bank_status(file: h5py.File, count: int) -> NDArray[np.uint8] | None:
    """Status bits that our own export keeps."""
    if not hdf5_reading.has(file, "BankStatus"):
        return None
    status = hdf5_reading.read_floats(file, "/BankStatus").reshape(-1)
    return status.astype(np.uint8) if len(status) == count and np.isin(status, np.arange(32)).all() else None


class _Responses:
    """Responses of each measurement and receiver, (emitters, samples), with their delays."""

    def __init__(
        self,
        path: Path,
        datasets: list[h5py.Dataset | WithMissing],
        axes: str,
        receivers: NDArray[np.int64],
        delay: Float64Array,
    ) -> None:
        self._path, self._datasets, self._axes = path, datasets, axes
        self._receivers, self._delay = receivers, delay
        fractional = bool((delay % 1).any())
        self.extra = int(np.ceil(delay.max())) + (_SINC if fractional else 0)

    def in_order(self) -> Any:
        """Yield (emitters, samples) of each receiver of each measurement."""
        for number, block in enumerate(self._measurements()):
            for receiver in self._receivers:
                yield self._delayed(block[receiver], self._delay[number, receiver])

    def placed(self, rows: NDArray[np.int64], columns: NDArray[np.int64], shape: tuple[int, int]) -> NDArray[Any]:
        """All responses at their places, (positions, actuators, samples); NaN where a pair was not measured."""
        samples = self._datasets[0].shape[self._axes.index("n")] + self.extra
        kind = np.complex64 if len(self._datasets) > 1 else np.float32
        needed = int(shape[0]) * int(shape[1]) * samples * np.dtype(kind).itemsize
        require_honest(self._path, "every pair of a position and an actuator", needed, self._path.stat().st_size)
        whole = np.full((*shape, samples), np.nan, kind)
        for number, block in enumerate(self._measurements()):
            for index, receiver in enumerate(self._receivers):
                row = rows[number, index]
                if np.isfinite(whole[row, columns[number], 0]).any():
                    raise InputError(
                        f"{self._path}: measurement {number} has the same places as an earlier one; name what"
                        " measurements count with --measurements positions or actuators"
                    )
                whole[row, columns[number]] = self._delayed(block[receiver], self._delay[number, receiver])
        return whole

    def _measurements(self) -> Any:
        """Yield (receivers, emitters, samples) of each measurement."""
        first = self._datasets[0]
        row_bytes = first.size // len(first) * first.dtype.itemsize
        parts = [blocks(dataset, row_bytes, (dataset.chunks or (1,))[0]) for dataset in self._datasets]
        for found in zip(*parts, strict=True):
            block = found[0] if len(found) == 1 else found[0] + 1j * found[1]
            if "e" not in self._axes:
                block = block[:, None, :]
            elif self._axes.endswith("ne"):
                block = block.transpose(0, 2, 1)
            yield block

    def _delayed(self, responses: NDArray[Any], delay: Float64Array) -> NDArray[Any]:
        """Responses (emitters, samples), each later by its delay in samples, which may be a fraction."""
        if not self.extra:
            return responses
        emitters, samples = responses.shape
        late = np.zeros((emitters, samples + self.extra))
        for emitter, first in enumerate(np.floor(delay).astype(int)):
            late[emitter, first : first + samples] = responses[emitter]
        part = delay % 1
        if part.any():
            length = 2 * late.shape[1]
            turn = np.exp(-2j * np.pi * np.arange(length // 2 + 1) / length * part[:, None])
            late = np.fft.irfft(np.fft.rfft(late, length) * turn, length)[:, : late.shape[1]]
        return late


_SINC = 32
"""Samples added after a response that is delayed by a fraction of a sample."""
