"""Banks in Python: estimated, imported and exported as the commands do, with paths or open files, without printing."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from wavefocus.storage.argument_types import Positions, checked, real_array
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource

OnProgress = Callable[[int, int], None]
LOG = logging.getLogger("wavefocus")


@dataclass(frozen=True, slots=True)
class Export:
    """An export: what was written, about how many bytes, and what was left out or is NaN."""

    out: Path
    format: str
    positions: int
    left_out: int
    nan: int
    actuators: int
    taps: int
    sample_rate_hz: float
    response_unit: str
    files: tuple[str, ...]
    bytes: int
    publication: Mapping[str, str]


@checked
def import_bank(
    source: str | Path,
    bank: str | Path,
    kind: Literal["", "sofa", "uff", "mat", "npz", "npy", "netcdf", "wav"] = "",
    *,
    places: str | Path | None = None,
    unit: str = "",
    length_unit: Literal["", "m", "cm", "mm", "um", "in", "ft"] = "",
    to_velocity: bool = False,
    band_hz: Sequence[float] | None = None,
    taps: int | None = None,
    sample_rate_hz: float | None = None,
    frequencies: Sequence[float] | str | Path | None = None,
    end: Literal["keep", "window", "damp"] = "keep",
    direction: str = "",
    columns: str = "",
    axes: str = "",
    names: Mapping[str, str] | None = None,
    measurements: Literal["", "positions", "actuators", "pairs"] = "",
    swap_roles: bool = False,
    force: bool = False,
    on_progress: OnProgress | None = None,
) -> Bank:
    """Make a bank of responses that were measured elsewhere, as ``wavefocus import``.

    Frequency responses become causal impulse responses. A fact that the file lacks is asked for by an error, never
    guessed.

    Parameters
    ----------
    source
        The file; for ``"wav"`` a folder.
    bank
        Path of the bank to write.
    kind
        Format of the file; recognised by default.
    places
        CSV table of places: ``x_mm,y_mm``, ``x_m,y_m`` or ``azimuth_deg,elevation_deg,radius_m``, and ``role``.
    unit
        Unit of the values, response over drive, as ``"m/s/V"`` or ``"g/N"``.
    length_unit
        Unit of places that have none: ``"m"``, ``"cm"``, ``"mm"``, ``"um"``, ``"in"`` or ``"ft"``.
    to_velocity
        Whether displacement or acceleration becomes velocity in m/s.
    band_hz
        Lowest and highest frequency to use, in Hz.
    taps
        Length of the Green's functions in samples.
    sample_rate_hz
        Rate of the Green's functions in Hz.
    frequencies
        Frequencies of complex values where the file holds none: the first and the step in Hz, or a file with all.
    end
        Ends of the Green's functions: as they are, a half cosine over the last tenth, or damped to -60 dB.
    direction
        Response direction: x, y, z (uff), receiver (sofa) or index (arrays).
    columns
        Coordinates that become x and y of the bank, as ``"x,z"``; by default the positions' own plane.
    axes
        Order of an array's axes, as ``"actuator,position,sample"``.
    names
        Variables of the file by our names, as ``{"green": "H"}``.
    measurements
        What the measurements of a SOFA file count.
    swap_roles
        Whether positions are where it was driven, and actuators where it was measured: reciprocity, as with a roving
        hammer.
    force
        Whether an older file of that name may be replaced; a bank never is.
    on_progress
        Called with the positions done and the positions in all.

    Returns
    -------
    Bank
        Open for reading. ``import_report`` is a JSON text: what was read, assumed and left out, and warnings, which
        also go to the logger ``wavefocus``.

    Raises
    ------
    InputError
        The file cannot be read, lacks a fact that a parameter can give, or the bank may not be written.

    Examples
    --------
    >>> import numpy as np
    >>> import wavefocus as wf
    >>> green = np.zeros((3, 2, 400))
    >>> green[:, :, 7] = 1e-3
    >>> np.savez("other.npz", green=green, sample_rate_hz=8000.0, position_mm=[[0, 0], [5, 0], [0, 5]])
    >>> with wf.import_bank("other.npz", "imported.h5", unit="mm/s/V", to_velocity=True) as bank:
    ...     print(bank.green(1).shape, bank.response_unit)
    (2, 400) m/s/V
    """
    from wavefocus.calibration.imports import bank as imports
    from wavefocus.options import ImportOptions

    options = ImportOptions(
        places=None if places is None else Path(places),
        unit=unit,
        length_unit=length_unit,
        direction=direction,
        axes=axes,
        names=names or {},
        frequencies=(Path(frequencies) if isinstance(frequencies, str | Path) else _pair("frequencies", frequencies)),
        sample_rate_hz=sample_rate_hz,
        measurements=measurements,
        swap_roles=swap_roles,
        columns=columns,
        taps=taps,
        band_hz=_pair("band_hz", band_hz),
        to_velocity=to_velocity,
        end=end,
    )
    made = imports.import_bank(Path(source), Path(bank), options, kind, on_progress, force=force)
    for warning in made.facts["warnings"]:
        LOG.warning("%s: %s", source, warning)
    return open_bank(bank)


@checked
def export_bank(
    bank: Bank | str | Path,
    out: str | Path,
    to: Literal["sofa", "uff", "wav", "mat", "npz", "netcdf", "csv"],
    *,
    positions: Positions | None = None,
    missing: Literal["leave-out", "nan"] = "leave-out",
    per: Literal["position", "actuator"] = "position",
    binary: bool = False,
    convention: Literal["GeneralFIR-E", "SingleRoomMIMOSRIR"] = "GeneralFIR-E",
    publication: str | Path | None = None,
    force: bool = False,
    on_progress: OnProgress | None = None,
) -> Export:
    """Write a bank in the format of another field, as ``wavefocus export``.

    Parameters
    ----------
    bank
        An open bank, or its path.
    out
        The file to write; for ``"wav"`` a folder.
    to
        The format.
    positions
        Rows of the bank, in any order, or a mask of them; by default all.
    missing
        Positions that are not measured, failed or disabled are left out, or hold NaN.
    per
        What one file of ``"wav"`` holds.
    binary
        Whether universal files hold binary numbers.
    convention
        Convention of a SOFA file; that of a room's many loudspeakers is what room acoustics reads.
    publication
        TOML file whose table ``[publication]`` names title, people and licence; by default the bank's own run.
    force
        Whether older files of these names may be replaced; banks never are.
    on_progress
        Called with the positions done and the positions in all.

    Returns
    -------
    Export
        Names and about how many ``bytes`` of the ``files``, and how many ``positions`` they hold, ``left_out`` or as
        ``nan``.

    Raises
    ------
    InputError
        The bank does not fit the format, or a file may not be written.

    Examples
    --------
    >>> import wavefocus as wf
    >>> wf.export_bank("plate.h5", "plate.mat", "mat", positions=[0, 7]).files
    ('plate.mat',)
    """
    from wavefocus.configuration import publication_of
    from wavefocus.storage.exchange import EXPORTS
    from wavefocus.storage.exchange.exported_rows import choose_rows
    from wavefocus.storage.output_files import require_outputs, require_replaceable_folder
    from wavefocus.storage.sidecar_files import clear_leftovers

    folder, missing_as_nan = Path(out), missing == "nan"
    form = EXPORTS[to]
    if missing_as_nan and not form.holds_nan:
        raise InputError(f"--missing nan: {to} files hold no NaN; missing positions are left out there")
    if binary and to != "uff":
        raise InputError(f"binary: is for uff; {to} files are always the same")
    if convention != "GeneralFIR-E" and to != "sofa":
        raise InputError(f"convention: is for sofa; {to} files have none")
    if folder.exists() and folder.is_dir() != form.folder:
        raise InputError(f"{out} is a {'folder' if folder.is_dir() else 'file'}; --to {to} writes a "
                         f"{'folder of files' if form.folder else 'file'}")  # fmt: skip
    with open_bank(bank) if isinstance(bank, str | Path) else nullcontext(bank) as view:
        inputs = [view.path, *([Path(publication)] if publication else [])]
        beside = folder.with_name(folder.name + form.notes_ending) if form.notes_ending else None
        if folder.parent.is_dir():
            clear_leftovers(folder.parent)  # what an export that was killed all but finished
        if not form.folder:
            require_outputs((folder, beside), inputs, force=force)
        view.require_sound(positions)
        texts = publication_of(view, Path(publication) if publication else None).texts
        if view.notes:
            texts["notes"] = "\n".join(map(str, view.notes))
        rows = choose_rows(
            view, positions, missing_as_nan=missing_as_nan, per=per, binary=binary, convention=convention,
            publication=texts,
        )  # fmt: skip
        writer = import_module(form.module)
        names = writer.file_names(rows) if form.folder else [folder.name]
        if beside is not None and view.notes:
            names.append(beside.name)
        if form.folder:
            ours = writer.older_files(folder) | set(names)
            require_replaceable_folder(folder, ours, inputs, by="export", force=force)
        writer.write(folder, rows, on_progress or (lambda done, total: None))
        per_value = 4 if binary else form.value_bytes
        return Export(
            out=folder,
            format=to,
            positions=len(rows.row),
            left_out=rows.left_out,
            nan=int(np.count_nonzero(~rows.known)),
            actuators=view.actuators,
            taps=view.taps,
            sample_rate_hz=view.sample_rate_hz,
            response_unit=view.response_unit,
            files=tuple(names),
            bytes=len(rows.row) * (view.actuators * view.taps * per_value + 100),
            publication=dict(rows.publication),
        )


@contextmanager
def opened_bank(bank: GreenSource | str | Path) -> Iterator[GreenSource]:
    """The bank, opened and closed where it is a path. Raises InputError: it is neither a path nor a bank."""
    from wavefocus.rendering.greens.source import require_source

    if not isinstance(bank, str | Path):
        require_source(bank)
    with open_bank(bank) if isinstance(bank, str | Path) else nullcontext(bank) as view:
        if isinstance(view, Bank):
            view.require_sound()
        yield view


def _pair(name: str, value: Sequence[float] | None) -> tuple[float, float] | None:
    """Two numbers of a public argument."""
    if value is None:
        return None
    numbers = real_array(name, value)
    if numbers.shape != (2,):
        raise InputError(f"{name} has shape {numbers.shape}; two numbers are needed")
    return float(numbers[0]), float(numbers[1])
