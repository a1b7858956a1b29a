"""Banks in the formats of other fields: acoustics, modal analysis, sound, numerical tools.

A format is a module here. With `write` it has an entry of `EXPORTS` and a line in tests/system/test_export.py, with
`read` an entry of `IMPORTS` and a line in tests/system/test_import.py.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class _ExportFormat:
    """A format that ``wavefocus export --to`` writes.

    module: Module of this package with ``write(path, rows, on_progress)``; one that writes a folder has
        ``file_names(rows)`` and ``older_files(folder)`` too.
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
    "sofa": _ExportFormat("sofa", "SOFA", value_bytes=8),
    "uff": _ExportFormat("uff", "universal files", holds_nan=False, value_bytes=20),
    "wav": _ExportFormat("wav", "WAV", folder=True, holds_nan=False),
    "mat": _ExportFormat("mat", "MATLAB"),
    "npz": _ExportFormat("named_arrays", "NumPy"),
    "netcdf": _ExportFormat("netcdf", "netCDF"),
    "csv": _ExportFormat("places", "a table of positions", value_bytes=0),
}


@dataclass(frozen=True, slots=True)
class _ImportFormat:
    """A format that ``wavefocus import --from`` reads.

    module: Module of this package with ``read(path, options, stack)``, of which the `ExitStack` closes what stays open;
        returns `wavefocus.storage.exchange.measured.Measured`.
    title: The format's name in the command's help and in messages.
    options: Options of the command that concern some formats, and this one.
    starts: How a file of the format begins.
    endings: How its name ends, where its content does not decide.
    """

    module: str
    title: str
    options: tuple[str, ...] = ()
    starts: tuple[bytes, ...] = ()
    endings: tuple[str, ...] = ()


_ARRAYS = ("direction", "axes", "names", "frequencies")

IMPORTS = {
    "sofa": _ImportFormat("sofa", "a SOFA file", ("direction", "measurements"), endings=(".sofa",)),
    "uff": _ImportFormat(
        "uff", "a universal file", ("direction",), (b"    -1\n", b"    -1\r\n"), (".uff", ".unv", ".uf")
    ),
    "mat": _ImportFormat("mat", "a MATLAB file", _ARRAYS, (b"MATLAB 5.0", b"MATLAB 7.3"), (".mat",)),
    "npz": _ImportFormat("named_arrays", "a NumPy archive", _ARRAYS, (b"PK",), (".npz",)),
    "npy": _ImportFormat("named_arrays", "a NumPy array", _ARRAYS, (b"\x93NUMPY",), (".npy",)),
    "netcdf": _ImportFormat("netcdf", "a netCDF file", _ARRAYS, (b"CDF", b"\x89HDF"), (".nc", ".nc4", ".cdf")),
    "wav": _ImportFormat("wav", "a folder of WAV files"),
}
SOME_FORMATS = frozenset(option for form in IMPORTS.values() for option in form.options)
"""Options that concern only some formats."""
