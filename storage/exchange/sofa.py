"""A bank as SOFA (AES69), convention GeneralFIR-E: what acoustics reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from storage.errors import InputError
from storage.exchange.bank_rows import BankRows, Float64Array, OnProgress, required_package
from storage.output_files import replacement, require_room

CONVENTION = "GeneralFIR-E"
_METADATA_BYTES = 1 << 18


def write(path: Path, rows: BankRows, on_progress: OnProgress | None = None) -> None:
    """Write a SOFA file: measurements are positions, emitters are actuators, the one receiver is the laser's spot.

    Lengths are metres there; the listener stands at the position, the receiver at the listener. Actuators whose place
    is unknown stand at NaN. ``BankPosition`` and ``BankStatus`` hold each measurement's row and status in the bank.
    The bank is held in memory whole, as float64.
    """
    sofar, bank = required_package("sofar", "sofa"), rows.bank
    sofa = sofar.Sofa(CONVENTION)
    sofa.Data_IR = np.ascontiguousarray(rows.green(np.float64, on_progress).transpose(0, 2, 1)[:, None, :, :])
    sofa.Data_SamplingRate = float(bank.sample_rate_hz)
    sofa.Data_Delay = np.zeros((1, 1, bank.actuators))
    sofa.ListenerPosition = _metres(rows.position_mm)
    sofa.ListenerPosition_Type, sofa.ListenerPosition_Units = "cartesian", "metre"
    sofa.ReceiverPosition = np.zeros((1, 3))
    sofa.SourcePosition = np.zeros((1, 3))
    sofa.SourcePosition_Type, sofa.SourcePosition_Units = "cartesian", "metre"
    sofa.EmitterPosition = _metres(bank.actuator_mm)
    sofa.GLOBAL_Title = f"Green's functions of {bank.path.name}"
    sofa.GLOBAL_ApplicationName, sofa.GLOBAL_ApplicationVersion = "wavefocus", "1"
    band = "unknown" if bank.band_hz is None else f"{bank.band_hz[0]:g} to {bank.band_hz[1]:g} Hz"
    sofa.GLOBAL_Comment = (
        f"Data.IR is in {bank.response_unit}, tap 0 at the drive sample; band {band}; coordinates on the surface,"
        " origin at its centre, x right, y up, seen from the laser"
    )
    sofa.add_variable("BankPosition", rows.row.astype(np.float64), "double", "M")
    sofa.add_variable("BankStatus", rows.status.astype(np.float64), "double", "M")
    with replacement(path) as temporary:
        # The package writes to names that end in .sofa alone.
        named = temporary.with_name(temporary.name + ".sofa")
        require_room(temporary, sofa.Data_IR.nbytes + _METADATA_BYTES)
        try:
            sofar.write_sofa(str(named), sofa)
        except RuntimeError as error:  # what its HDF5 says
            raise InputError(f"{path} cannot be written ({error})") from error
        named.replace(temporary)


def _metres(points_mm: Float64Array) -> Float64Array:
    return np.column_stack([points_mm / 1e3, np.zeros(len(points_mm))])
