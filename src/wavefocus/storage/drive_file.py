"""The drive file, docs/reference/files.md: what each actuator plays."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from wavefocus.storage import hdf5_digest, hdf5_reading
from wavefocus.storage.argument_types import check_fields, checked, real_array, require_times, whole_array
from wavefocus.storage.errors import InputError
from wavefocus.storage.hdf5_writing import (
    attach,
    dimension_scale,
    filled,
    reserved,
    sample_times,
    sealed_output,
    set_long_names,
)  # fmt: skip
from wavefocus.storage.units import drive_of

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

FORMAT = "wavefocus-drive"
_FOCUS_AXES = ("x_mm", "y_mm")
LONG_NAMES = {
    "drive": "voltage at each actuator",
    "actuator": "index of the actuator",
    "time_s": "scene time",
    "focus/focus": "index of the focus",
    "focus/sample": "sample of the focus after scene time zero",
    "focus/position": "row of the bank that the focus is at",
    "focus/source": "index of the source",
    "focus/x_mm": "place of the focus, x",
    "focus/y_mm": "place of the focus, y",
}


@dataclass(frozen=True, slots=True, eq=False)
class QuietTrack:
    """A place at which a drive was made to be quiet.

    name: ``"quiet[0]"``, or ``"source 1"`` where it is that of a source, and the others are quiet there.
    sample, int64 (instants,): Instants in samples after time zero, rising; one where the place rests.
    at_mm, float64 (instants, 2): Where it is.
    radius_mm: Radius of a disc; 0 for a point.
    level_db: Level asked for: energy of the response there over that at the loudest focus.
    rendered_db: Level that the renderer found while it made the filters.
    source: The source that sounds there; -1 for a quiet place.
    interpolation: Method of its rows where it lies between positions.
    """

    name: str
    sample: Int64Array
    at_mm: Float64Array
    radius_mm: float
    level_db: float
    rendered_db: float
    source: int = -1
    interpolation: str = "kernel"

    def plain(self) -> dict[str, Any]:
        """As JSON holds it."""
        values = {key: getattr(self, key) for key in self.__slots__}
        return {**values, "sample": self.sample.tolist(), "at_mm": self.at_mm.tolist()}

    @classmethod
    def of_plain(cls, values: dict[str, Any]) -> QuietTrack:
        """Make it of `plain`. Raises KeyError, TypeError or ValueError: something else was given."""
        sample, at_mm = np.asarray(values["sample"], np.int64), np.asarray(values["at_mm"], np.float64)
        track = cls(
            str(values["name"]), sample, at_mm, float(values["radius_mm"]), float(values["level_db"]),
            float(values["rendered_db"]), int(values["source"]), str(values["interpolation"]),
        )  # fmt: skip
        numbers = (track.radius_mm, track.level_db, track.rendered_db)
        if not len(sample) or at_mm.shape != (len(sample), 2) or (np.diff(sample) <= 0).any():
            raise ValueError("instants and places differ in number, or instants do not rise")
        if not (np.isfinite(at_mm).all() and np.isfinite(numbers).all() and track.radius_mm >= 0):
            raise ValueError("a number is out of range")
        return track


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """What each actuator plays, and which instants it was made for; out of range, InputError.

    drive_v, float64 (N, n): Volts at each actuator, finite.
    sample_rate_hz: Rate in Hz, > 0.
    start_s: Time of the first sample, negative because of the lead-in.
    method: How it was rendered.
    scale: Factor by which a limit scaled it down, 0 < scale; 1 if nothing did.
    omitted_bound: Bound on the relative L2 error from everything left out, >= 0; 0 when exact.
    focus_sample, focus_position, focus_source, int64 (K,): Each focus: its sample n_m after time zero, its row of the
        bank, its source.
    drive_unit: Unit of the drive, that of the bank.
    verified: Whether the file that it was read from carries checksums of all its values.
    quiet: Places at which it is quiet.
    focus_mm, float64 (K, 2): Place of each focus; None: those of the rows `focus_position`.
    """

    drive_v: Float64Array
    sample_rate_hz: float
    start_s: float
    method: str
    scale: float
    omitted_bound: float
    focus_sample: Int64Array
    focus_position: Int64Array
    focus_source: Int64Array
    drive_unit: str = "V"
    verified: bool = True
    quiet: tuple[QuietTrack, ...] = ()
    focus_mm: Float64Array | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        object.__setattr__(self, "drive_v", np.ascontiguousarray(real_array("drive_v", self.drive_v)))
        if self.drive_v.ndim != 2 or not self.drive_v.size:
            raise InputError(f"/drive has shape {self.drive_v.shape}; (actuator, sample), each 1 or more, is needed")
        if not np.isfinite(self.drive_v).all():
            actuator = int(np.flatnonzero(~np.isfinite(self.drive_v).all(axis=1))[0])
            raise InputError(f"/drive of actuator {actuator} holds NaN or infinities; finite volts are needed")
        require_times(self.sample_rate_hz, self.start_s)
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise InputError(f"scale is {self.scale}; a factor above 0 is needed")
        if not self.omitted_bound >= 0:
            raise InputError(f"omitted_bound is {self.omitted_bound}; 0 or more is needed")
        for name in ("focus_sample", "focus_position", "focus_source"):
            object.__setattr__(self, name, np.ascontiguousarray(whole_array(name, getattr(self, name))))
        shapes = {self.focus_sample.shape, self.focus_position.shape, self.focus_source.shape}
        if len(shapes) != 1 or self.focus_sample.ndim != 1:
            raise InputError(f"/focus datasets have shapes {sorted(shapes)}; one common length is needed")
        if self.focus_mm is not None:
            object.__setattr__(self, "focus_mm", np.ascontiguousarray(real_array("focus_mm", self.focus_mm)))
            if self.focus_mm.shape != (len(self.focus_sample), 2) or not np.isfinite(self.focus_mm).all():
                raise InputError("focus_mm is not a finite place (x, y) in mm for each focus")

    def __repr__(self) -> str:
        """Its size and how it was made, in one line."""
        actuators, samples = self.drive_v.shape
        return (
            f"Drive({actuators} actuators, {samples} samples at {self.sample_rate_hz:g} Hz from {self.start_s:g} s, "
            f"{len(self.focus_sample)} foci, {self.method}, {self.drive_unit})"
        )


@checked
def write_drive(path: str | Path, drive: Drive, *, force: bool = False) -> None:
    """Write a drive file; it appears under its name only when it is whole.

    Parameters
    ----------
    path
        Name of the file.
    drive
        Volts, float64 (actuators, samples), and what is said of them.
    force
        Whether an older file of that name may be replaced; a bank, raw recordings or a link never is.

    Raises
    ------
    InputError
        The file exists and may not be replaced, or cannot be written.

    Examples
    --------
    >>> import wavefocus as wf
    >>> wf.write_drive("copy.h5", wf.read_drive("drive.h5"))
    """
    about = {name: getattr(drive, name) for name in ("sample_rate_hz", "start_s", "method", "drive_unit", "focus_mm")}
    foci = (drive.focus_sample, drive.focus_position, drive.focus_source)
    with drive_in_blocks(path, drive.drive_v.shape, foci=foci, force=force, **about) as written:
        written.put(0, drive.drive_v)
        written.finish(1.0, scale=drive.scale, omitted_bound=drive.omitted_bound, quiet=drive.quiet)


class _DriveWriter:
    """The volts of a drive file that is being written."""

    def __init__(self, volts: h5py.Dataset) -> None:
        self._volts, self._digest = volts, ""

    def put(self, first: int, block: Float64Array) -> None:
        """Write volts, (actuators, some samples), from the sample `first` on; a later block replaces an earlier one."""
        whole = block.shape == self._volts.shape
        self._digest = hdf5_digest.values_sha256(block) if whole else ""
        self._volts[:, first : first + block.shape[1]] = block

    def whole(self) -> Float64Array:
        """All volts as they are now, in memory."""
        return np.asarray(self._volts[:], np.float64)

    def finish(self, factor: float, *, scale: float, omitted_bound: float, quiet: tuple[QuietTrack, ...] = ()) -> None:
        """Multiply all volts by a factor, and say how they came about: see `Drive`."""
        if factor != 1.0:
            self._digest = ""
            for pieces in _pieces(self._volts):
                self._volts[:, pieces] = factor * self._volts[:, pieces]
        if self._digest:
            self._volts.attrs[hdf5_digest.VALUES] = self._digest
        about = self._volts.file.attrs
        about["scale"], about["omitted_bound"] = float(scale), float(omitted_bound)
        if quiet:
            about["quiet"] = json.dumps([track.plain() for track in quiet])


def _pieces(volts: h5py.Dataset) -> Iterator[slice]:
    """Samples that take little memory together."""
    step = max(1, 2**24 // (8 * volts.shape[0]))
    return (slice(first, first + step) for first in range(0, volts.shape[1], step))


@contextmanager
def drive_in_blocks(
    path: str | Path,
    shape: tuple[int, ...],
    *,
    sample_rate_hz: float,
    start_s: float,
    method: str,
    foci: tuple[Int64Array, Int64Array, Int64Array],
    drive_unit: str = "V",
    focus_mm: Float64Array | None = None,
    force: bool = False,
) -> Iterator[_DriveWriter]:
    """Write a drive file block by block, as `write_drive`; it appears under its name when the block ends well.

    shape: Actuators and samples of the whole drive.
    sample_rate_hz, start_s, method, drive_unit, focus_mm: See `Drive`.
    foci: Sample, position and source of each focus.

    Raises InputError: the file exists and may not be replaced, or cannot be written.
    """
    data_bytes = 8 * (shape[0] * shape[1] + shape[0] + shape[1] + 4 * len(foci[0]))
    about: dict[str, Any] = {"method": method, "drive_unit": drive_unit, "scale": 1.0, "omitted_bound": 0.0}
    about |= {"sample_rate_hz": float(sample_rate_hz), "start_s": float(start_s)}
    with sealed_output(Path(path), FORMAT, data_bytes, about, force=force) as file:
        volts = reserved(file, "/drive", shape, "<f8", drive_unit)
        focus = dimension_scale(file, "focus/focus", np.arange(len(foci[0])))
        for name, values in zip(("sample", "position", "source"), foci, strict=True):
            attach(filled(file, f"/focus/{name}", np.asarray(values, np.int64)), focus)
        for name, places_mm in zip(_FOCUS_AXES, () if focus_mm is None else focus_mm.T, strict=False):
            attach(filled(file, f"/focus/{name}", places_mm, "mm"), focus)
        actuator = dimension_scale(file, "actuator", np.arange(shape[0]))
        attach(volts, actuator, dimension_scale(file, "time_s", sample_times(shape[1], sample_rate_hz, start_s), "s"))
        set_long_names(file, LONG_NAMES)
        yield _DriveWriter(volts)


@contextmanager
def drive_pieces(path: str | Path) -> Iterator[Iterator[Float64Array]]:
    """Give the volts of a drive file piece by piece, (actuators, some samples), however long it is.

    Raises InputError: as `read_drive`, but for the checksums.
    """
    with hdf5_reading.opened_as(Path(path), FORMAT) as file:
        volts = hdf5_reading.plain_dataset(file, "/drive")
        yield (np.asarray(volts[:, piece], np.float64) for piece in _pieces(volts))


@checked
def read_drive(path: str | Path) -> Drive:
    """Read a drive file; what only describes it (method, scale, omitted_bound, foci) may be missing.

    Parameters
    ----------
    path
        A drive file.

    Returns
    -------
    Drive
        ``drive_v``, float64 (actuators, samples) in volts, from ``start_s`` on; ``verified`` is false where the file
        carries no checksums.

    Raises
    ------
    InputError
        The file is missing, damaged, no drive file, of a future version, or holds values out of range.

    Examples
    --------
    >>> import wavefocus as wf
    >>> drive = wf.read_drive("drive.h5")
    >>> drive.drive_v.shape, drive.start_s, drive.method
    ((4, 3499), -0.0999, 'sampled')
    """
    path = Path(path)
    with hdf5_reading.opened_as(path, FORMAT) as file:
        dataset = hdf5_reading.plain_dataset(file, "/drive")
        values = hdf5_reading.read_whole(dataset)
        sample, position, source = (
            hdf5_reading.read_integers(file, name) if hdf5_reading.has(file, name) else np.zeros(0, np.int64)
            for name in ("/focus/sample", "/focus/position", "/focus/source")
        )
        rate, start_s = (hdf5_reading.number(file, name) for name in ("sample_rate_hz", "start_s"))
        with hdf5_reading.named(path):
            scale, omitted = (hdf5_reading.number(file, *at) for at in (("scale", 1.0), ("omitted_bound", 0.0)))
            drive = Drive(
                np.asarray(values, np.float64), rate, start_s, hdf5_reading.text(file, "method") or "unknown", scale,
                omitted, sample, position, source, _drive_unit(file, dataset, path), quiet=_quiet(file, path),
                focus_mm=_focus_mm(file, len(sample)),
            )  # fmt: skip
        hdf5_reading.require_sample_times(file, values.shape[1], rate, start_s)
        # Last, so that a value that is wrong in itself is named.
        verified = hdf5_digest.require_all(file, apart="/drive")
        if hdf5_digest.VALUES in dataset.attrs:
            hdf5_digest.require_values(dataset, hdf5_digest.values_sha256(values))
    return drive if verified else replace(drive, verified=False)


def _drive_unit(file: h5py.File, dataset: h5py.Dataset, path: Path) -> str:
    """Unit of the drive: of the attribute ``drive_unit``, else of the dataset's ``units``, else volts."""
    stated, units = (
        None if (word := hdf5_reading.text(item, name)) is None else drive_of("", word)
        for item, name in ((file, "drive_unit"), (dataset, "units"))
    )
    if stated and units and stated != units:
        raise InputError(f"{path}: attribute drive_unit is {stated!r}, and /drive is in {units!r}; both must agree")
    return stated or units or "V"


def _quiet(file: h5py.File, path: Path) -> tuple[QuietTrack, ...]:
    if (text := hdf5_reading.text(file, "quiet")) is None:
        return ()
    try:
        return tuple(QuietTrack.of_plain(values) for values in json.loads(text))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: attribute quiet is not the list of quiet places that render writes") from error


def _focus_mm(file: h5py.File, foci: int) -> Float64Array | None:
    if not all(hdf5_reading.has(file, f"/focus/{axis}") for axis in _FOCUS_AXES):
        return None
    return np.stack([hdf5_reading.read_floats(file, f"/focus/{axis}", (foci,)) for axis in _FOCUS_AXES], axis=1)
