"""Banks in the formats of other fields: acoustics, modal analysis, sound, numerical tools.

A new format is a module here with `write`, an entry of `EXPORTS`, and a line in tests/system/test_export.py.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Export:
    """A format that ``wavefocus export --to`` writes.

    module: Module with ``write(path, rows, on_progress)``; one that writes a folder has ``file_names(rows)`` too.
    title: The format's name in the command's help.
    folder: It writes a folder of files instead of one file.
    holds_nan: It can hold rows without a measurement.
    value_bytes: Bytes per tap, position and actuator.
    """

    module: str
    title: str
    folder: bool = False
    holds_nan: bool = True
    value_bytes: int = 4


EXPORTS = {
    "sofa": Export("storage.exchange.sofa", "SOFA", value_bytes=8),
    "uff": Export("storage.exchange.uff", "universal files", holds_nan=False, value_bytes=20),
    "wav": Export("storage.exchange.wav", "WAV", folder=True, holds_nan=False),
    "mat": Export("storage.exchange.mat", "MATLAB"),
    "npz": Export("storage.exchange.npz", "NumPy"),
    "netcdf": Export("storage.exchange.netcdf", "netCDF"),
    "csv": Export("storage.exchange.places", "a table of positions", value_bytes=0),
}
