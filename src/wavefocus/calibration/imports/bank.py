"""Import: places in a plane, responses measured elsewhere as a bank, a report of what was read and assumed."""

import hashlib
import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration import Float64Array
from wavefocus.calibration.imports.conversion import Conversion
from wavefocus.calibration.numerics import one_blas_thread
from wavefocus.options import ImportOptions
from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.ledger import PointRecord, Status
from wavefocus.storage.bank.writer import write_bank
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.measured import Measured, opened, recognised
from wavefocus.storage.output_files import require_outputs

_FLAT = 1e-2
"""Largest distance from a plane, relative to the extent of the places, that still counts as flat."""
NEAR = 5e-2
"""Largest height of an actuator over the positions' plane, relative to the extent of all, whose foot is its place."""
_NAMES = "xyz"


@dataclass(frozen=True, slots=True)
class _Projection:
    """How places in space become places on the surface.

    axes, float64 (2, 3): Unit vectors of the bank's x and y in the file's coordinates.
    words: One clause about them.
    off_plane_m: Largest distance of a position from the plane.
    is_flat: Whether the positions lie in a plane.
    """

    axes: Float64Array
    words: str
    off_plane_m: float
    is_flat: bool

    def on_surface_mm(self, places_m: Float64Array) -> Float64Array:
        """Places (n, 3) in metres on the surface, (n, 2) in millimetres."""
        return places_m @ self.axes.T * 1e3

    def near_surface(self, places_m: Float64Array, position_m: Float64Array) -> NDArray[np.bool_]:
        """Whether places (n, 3) lie so near to the surface of the positions that `on_surface_mm` says where; bool (n,).

        That is within `NEAR` of the extent of all of them, as on the back of a plate. NaN counts as near.
        """
        everywhere = np.vstack([position_m, places_m[np.isfinite(places_m).all(axis=1)]])
        extent = float(np.linalg.norm(np.ptp(everywhere, axis=0)))
        height = np.abs((places_m - position_m.mean(axis=0)) @ np.cross(*self.axes))
        return np.asarray(~(height > max(NEAR * extent, self.off_plane_m, 1e-9)))


def _choose_projection(places_m: Float64Array, columns: str) -> _Projection:
    """Choose the surface that positions lie on.

    places_m, float64 (P, 3): Places in metres.
    columns: Two of x, y and z with a comma, or empty: then two of them where the third is the same for all positions,
        else the plane that fits best.

    Raises InputError: the columns are none, or the positions lie in no plane and no columns are named.
    """
    if not np.isfinite(places_m).all():
        missing = int(np.flatnonzero(~np.isfinite(places_m).all(axis=1))[0])
        raise InputError(f"the place of position {missing} is missing; each position needs one, as with --places")
    extent = float(np.linalg.norm(np.ptp(places_m, axis=0)))
    spread = np.ptp(places_m, axis=0)
    if columns:
        names = [name.strip() for name in columns.split(",")]
        if len(names) != 2 or names[0] == names[1] or not set(names) <= set(_NAMES):
            raise InputError(f"--columns is {columns!r}; two of x, y and z are needed, as x,y")
        first, second = (_NAMES.index(name) for name in names)
        third = 3 - first - second
        axes = np.eye(3)[[first, second]]
        off = float(spread[third]) / 2
        return _Projection(axes, f"columns {columns} of the places, as asked", off, off <= _FLAT * extent)
    for third in (2, 0, 1):  # the plane x, y where it will do
        if spread[third] <= 1e-9:
            kept = [index for index in range(3) if index != third]
            value = places_m[0, third] * 1e3
            words = (
                f"{_NAMES[kept[0]]} and {_NAMES[kept[1]]} of the places; {_NAMES[third]} is {value:.6g} mm throughout"
            )
            return _Projection(np.eye(3)[kept], words, 0.0, True)
    normal = np.linalg.svd(places_m - places_m.mean(axis=0), full_matrices=True)[2][2]
    off = float(np.abs((places_m - places_m.mean(axis=0)) @ normal).max())
    if off > _FLAT * extent:
        raise InputError(
            f"the positions lie in no plane: up to {off * 1e3:.3g} mm from the one that fits best, and their extent is"
            f" {extent * 1e3:.3g} mm; choose two coordinates with --columns, as --columns x,y"
        )
    normal *= np.sign(normal[np.argmax(np.abs(normal))])
    start = np.eye(3)[0] if abs(normal[0]) < 0.9 else np.eye(3)[1]
    across = start - normal * (start @ normal)
    across /= np.linalg.norm(across)
    axes = np.array([across, np.cross(normal, across)])
    words = (
        f"the plane that fits best, up to {off * 1e3:.3g} mm from the positions; its normal is"
        f" ({normal[0]:.3f}, {normal[1]:.3f}, {normal[2]:.3f})"
    )
    return _Projection(axes, words, off, True)


OnProgress = Callable[[int, int], None]

_SENSELESS_DB = 200.0
"""Levels of positions are nearer to each other than this: converters of 24 bits span 144 dB."""
_NOT_A_SURFACE = (
    "the places are a projection of places in space, so distances on the surface are not those of the waves"
)
_NOT_A_PLATE = "the responses are no motion of a surface, and its model is of waves in a plate"


def import_bank(
    source: Path,
    bank: Path,
    options: ImportOptions,
    kind: str = "",
    on_progress: OnProgress | None = None,
    *,
    force: bool = False,
) -> tuple[dict[str, Any], dict[str, int]]:
    """Make a bank of a file, or a folder of sound files, of another format.

    source: The file or folder.
    bank: The bank to write.
    kind: Its format, a key of `wavefocus.storage.exchange.IMPORTS`; recognised where empty.
    on_progress: Called with positions done and positions in all.
    force: Whether an older file of that name is replaced when the new one is whole; a bank and the inputs never are.

    Returns the report as the bank stores it: ``paragraph``, ``source``, ``format``, ``read``, ``assumed``,
    ``left_out``, ``warnings``, ``residual_db``, ``unsuited`` (interpolations that are refused, and why) and ``caution``
    (a warning of every render, or empty); and the numbers of ``positions``, of those ``measured``, of ``actuators`` and
    ``taps``.
    Raises InputError: the file cannot be read or lacks a fact that an option can give, or the bank may not be written.
    """
    listed = options.frequencies if isinstance(options.frequencies, Path) else None
    inputs = [source, options.places, listed, *(sorted(source.iterdir()) if source.is_dir() else [])]
    require_outputs((bank,), inputs, force=force)
    kind = kind or recognised(source)
    with opened(source, kind, options) as found, one_blas_thread():
        measured = _swapped(found, source) if options.swap_roles else found
        try:
            projection = _choose_projection(measured.position_m, options.columns)
        except InputError as error:
            raise InputError(f"{source}: {error}") from None
        conversion = Conversion(measured, options, source)
        with _written(bank), tempfile.TemporaryFile(dir=bank.absolute().parent) as spool:
            records: list[tuple[int, PointRecord]] = []
            peaks: list[float] = []
            for position, green, residual_db in conversion.rows():
                if green is not None:
                    spool.write(green.tobytes())
                    records.append((position, _record(measured, position, residual_db)))
                    peaks.append(float(np.abs(green).max()))
                if on_progress is not None:
                    on_progress(position + 1, measured.shape[0])
            if not records:
                raise InputError(f"{source}: no position holds a response; there is nothing to import")
            senseless = _require_levels(records, peaks)
            facts = _facts(source, kind, measured, conversion, projection, len(records), options, senseless)
            report = json.dumps(facts)
            taps = conversion.taps
            header = BankHeader(
                sample_rate_hz=conversion.rate_hz,
                taps=taps,
                band_hz=conversion.band_hz,
                position_mm=projection.on_surface_mm(measured.position_m),
                actuator_mm=np.where(
                    projection.near_surface(measured.actuator_m, measured.position_m)[:, None],
                    projection.on_surface_mm(measured.actuator_m),
                    np.nan,
                ),
                rig_json="",
                run_json="",
                plan_sha256=hashlib.sha256(report.encode()).hexdigest(),
                software=f"wavefocus {version('wavefocus')}, import",
                response_unit=conversion.response_unit,
                drive_unit=conversion.drive_unit,
                import_report=report,
            )
            spool.seek(0)
            row_bytes = 4 * measured.shape[1] * taps
            write_bank(
                bank,
                header,
                (
                    (position, np.frombuffer(spool.read(row_bytes), np.float32).reshape(-1, taps), record)
                    for position, record in records
                ),
                measured.notes,
            )
    count, actuators, _ = measured.shape
    return facts, {"positions": count, "measured": len(records), "actuators": actuators, "taps": taps}


def _require_levels(records: list[tuple[int, PointRecord]], peaks: list[float]) -> list[int]:
    """Mark as poor, and return, the positions whose largest value no instrument measures beside the others'."""
    level_db = 20 * np.log10(np.maximum(peaks, 1e-300))
    senseless = np.flatnonzero(np.abs(level_db - np.median(level_db)) > _SENSELESS_DB).tolist()
    for number in senseless:
        position, record = records[number]
        records[number] = position, replace(record, status=int(Status.POOR_SIGNAL))
    return [records[number][0] for number in senseless]


@contextmanager
def _written(bank: Path) -> Iterator[None]:
    """Name the bank where the disk fails."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{bank} cannot be written: {error.strerror or error}") from error


def _swapped(measured: Measured, source: Path) -> Measured:
    """Positions for actuators, and actuators for positions."""
    if not np.isfinite(measured.actuator_m).all():
        raise InputError(
            f"{source}: --swap-roles: the places of the actuators are not known, and they become positions"
        )
    count, actuators, samples = measured.shape
    kind = np.float32 if measured.frequency_hz is None else np.complex64
    whole = np.empty((actuators, count, samples), kind)
    for position, row in enumerate(measured.rows):
        whole[:, position] = row
    return replace(
        measured,
        rows=whole,
        shape=(actuators, count, samples),
        position_m=measured.actuator_m,
        actuator_m=measured.position_m,
        status=None,
        quality={},
        read=(
            *measured.read,
            "the roles are swapped: positions are where it was driven, actuators where it was measured",
        ),
    )


def _record(measured: Measured, position: int, residual_db: Float64Array | None) -> PointRecord:
    """Status and quality of a position, as the file has them."""
    figures: dict[str, Any] = {name: values[position] for name, values in measured.quality.items()}
    unknown = np.full(measured.shape[1], np.nan)
    each = {name: figures.get(name, unknown) for name in ("snr_db", "residual_db", "coherence", "peak_v")}
    each |= {} if residual_db is None else {"residual_db": residual_db.astype(np.float32)}
    each |= {name: float(figures.get(name, np.nan)) for name in ("moved_mm", "reference_db", "leak_db")}
    status = int(Status.VALID) if measured.status is None else int(measured.status[position])
    attempts = figures.get("attempts", 1)
    attempts = int(attempts) if np.isfinite(attempts) and 0 <= attempts < 1 << 24 else 1
    return PointRecord(status=status or int(Status.VALID), attempts=attempts, **each)


def _facts(
    source: Path,
    kind: str,
    measured: Measured,
    conversion: Conversion,
    projection: _Projection,
    rows: int,
    options: ImportOptions,
    senseless: list[int],
) -> dict[str, Any]:
    """The report of an import."""
    count, actuators, _ = measured.shape
    unknown = int((~np.isfinite(measured.actuator_m).all(axis=1)).sum())
    read = [
        *measured.read,
        f"{count} positions x {actuators} actuators x {conversion.taps} taps at {conversion.rate_hz:.9g} Hz, in"
        f" {conversion.response_unit}",
        *conversion.said,
        *conversion.ending(),
        f"places on the surface are {projection.words}",
    ]
    assumed = [*measured.assumed, *conversion.assumed]
    if measured.status is None:
        assumed.append("every position that holds responses is valid")
    if count == 1 < actuators and not options.swap_roles:
        assumed.append(
            "the one place of a response is the one position; --swap-roles makes the driven places positions"
        )
    left_out = list(measured.left_out)
    if rows < count:
        left_out.append(f"{count - rows} positions that hold no response")
    if unknown:
        left_out.append(f"places of {unknown} actuators, which are not known")
    warnings = [*conversion.warnings]
    if senseless:
        warnings.append(
            f"{len(senseless)} positions (the first is {senseless[0]}) lie more than {_SENSELESS_DB:g} dB from the"
            " median of all: fill values, or another unit; they are marked poor"
        )
    if far := np.flatnonzero(~projection.near_surface(measured.actuator_m, measured.position_m)).tolist():
        warnings.append(
            f"{len(far)} actuators lie off the surface of the positions (the first is {far[0]}); a bank holds places on"
            " the surface only, so theirs are left out"
        )
        left_out.append(f"places of {len(far)} actuators, which lie off the surface of the positions")
    unsuited = {} if conversion.is_motion else {"kernel": _NOT_A_PLATE}
    caution = ""
    if not projection.is_flat:
        unsuited = dict.fromkeys(("kernel", "bilinear"), _NOT_A_SURFACE)
        miss_mm = projection.off_plane_m * 2e3
        caution = f"{_NOT_A_SURFACE}: snapping to a position may miss it by up to {miss_mm:.3g} mm across"
    parts = {"Read": read, "Assumed": assumed, "Left out": left_out, "Warnings": warnings}
    paragraph = f"Imported from {source.resolve().name} ({kind})."
    paragraph += "".join(f" {title}: {'; '.join(said)}." for title, said in parts.items() if said)
    if unsuited:
        paragraph += f" Interpolation {', '.join(unsuited)} is refused: {next(iter(unsuited.values()))}."
    return {
        "paragraph": paragraph[:8000],
        "source": source.resolve().name,
        "format": kind,
        "read": read,
        "assumed": assumed,
        "left_out": left_out,
        "warnings": warnings,
        "residual_db": conversion.residual_db,
        "off_plane_mm": projection.off_plane_m * 1e3,
        "unsuited": unsuited,
        "caution": caution,
    }
