"""A bank as SOFA (AES69), convention GeneralFIR-E: what acoustics reads."""

from __future__ import annotations

from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from wavefocus.storage.exchange.bank_rows import BankRows, Float64Array, OnProgress
from wavefocus.storage.hdf5_writing import attach, bare_dimension, created, filled, reserved
from wavefocus.storage.output_files import replacement

CONVENTION = "GeneralFIR-E"


def write(path: Path, rows: BankRows, on_progress: OnProgress | None = None) -> None:
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
            attach(filled(file, name, np.asarray(values, np.float64), None), *(scales[one] for one in dimensions))
            for attribute, text in attributes.items():
                _set_text(file[name], attribute, text)

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
        attach(data, *(scales[one] for one in "MRNE"))
        for measurement, (_, green) in enumerate(rows.each(on_progress)):
            data[measurement, 0] = green.T


def _attributes(rows: BankRows) -> dict[str, str]:
    """Attributes of the whole file; AES69 demands most of them, also where nothing is known."""
    bank, about, now = rows.bank, rows.publication, f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S}"
    band = "unknown" if bank.band_hz is None else f"{bank.band_hz[0]:g} to {bank.band_hz[1]:g} Hz"
    attributes = {
        "Conventions": "SOFA",
        "Version": "2.1",
        "SOFAConventions": CONVENTION,
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
