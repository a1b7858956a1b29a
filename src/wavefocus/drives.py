"""Drives, fields and foci in Python: made as the commands do, with paths or open files, without printing."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from numpy.typing import ArrayLike, DTypeLike

from wavefocus.banks import OnProgress, opened_bank, options_from, taking
from wavefocus.options import RenderOptions
from wavefocus.storage.argument_types import Positions, checked
from wavefocus.storage.bank.reading import Bank
from wavefocus.storage.drive_file import Drive, read_drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import Field, read_field

if TYPE_CHECKING:
    from wavefocus.rendering.field.foci import FocusResults
    from wavefocus.rendering.field.quiet_levels import QuietLevel
    from wavefocus.rendering.greens.interpolation.errors import Interpolated
    from wavefocus.rendering.greens.source import GreenSource
    from wavefocus.rendering.scene.model import Scene


@taking(RenderOptions)
@checked
def render(
    scene: Scene | str | Path,
    bank: GreenSource | str | Path,
    *,
    on_progress: OnProgress | None = None,
    **options: Any,
) -> Drive:
    """Render a scene into the drives of all actuators, as ``wavefocus render``.

    The drive starts at -(L - 1) samples of scene time, L the taps of the bank, and ends with the last emitted sample.

    Parameters
    ----------
    scene
        A scene, or the path of a scene file.
    bank
        An open bank, an array of Green's functions (`GreenArray`), or the path of a bank.
    on_progress
        Called with the parts done and the parts in all.
    options
        As listed.

    Returns
    -------
    Drive
        ``drive_v``, float64 (actuators, samples), in volts, at the bank's rate.

    Raises
    ------
    InputError
        A file cannot be read, the scene does not fit the bank, or an option does not go with another.

    Warns
    -----
    RenderWarning
        The drives are as asked, and something about them is worth a look: loud ends, interpolation errors.

    Examples
    --------
    >>> import wavefocus as wf
    >>> drive = wf.render("scene.toml", "plate.h5")
    >>> drive.drive_v.shape, drive.drive_v.dtype
    ((4, 3499), dtype('float64'))
    >>> wf.write_drive("stroke.h5", drive)
    """
    from wavefocus.rendering.device import cuda_device
    from wavefocus.rendering.drive.rendering import render_with_report
    from wavefocus.rendering.report.render_report import RenderWarning
    from wavefocus.rendering.scene.model import load_scene

    chosen = options_from(RenderOptions, options)
    file = scene if isinstance(scene, str | Path) else None
    made = load_scene(scene) if isinstance(scene, str | Path) else scene
    with opened_bank(bank) as view, nullcontext() if file is None else naming(file, view):
        drive, report = render_with_report(
            made, view, on_progress, method=chosen.method, tolerance_db=chosen.tolerance_db,
            device=None if chosen.device == "cpu" else cuda_device(),
        )  # fmt: skip
    for text in report.warnings:
        warnings.warn(text, RenderWarning, stacklevel=3)
    return drive


@checked
def predict(
    drive: Drive | str | Path,
    bank: GreenSource | str | Path,
    positions: Positions | None = None,
    *,
    dtype: DTypeLike = "float64",
    rate_hz: float | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    on_progress: OnProgress | None = None,
) -> Field:
    """Predict the field that a drive makes (eq. 4), as ``wavefocus predict``, drive samples + L - 1 long.

    Parameters
    ----------
    drive
        A drive, or the path of a drive file.
    bank
        An open bank, an array of Green's functions (`GreenArray`), or the path of a bank; at the drive's rate.
    positions
        Rows of the bank, in any order, or a mask of them; by default all that are measured.
    dtype
        ``"float64"``, exact to 1e-12; or ``"float32"``, twice as fast, and exact to 1e-6 of each position's largest
        response.
    rate_hz
        Rate of the field, the bank's over a whole number; the field is low-passed to it. By default the bank's.
    device
        ``"cuda"`` computes on a GPU, and needs CuPy.
    on_progress
        Called with the positions done and the positions in all.

    Returns
    -------
    Field
        ``field``, (positions, samples), in the bank's response unit, m/s for a vibrometer; ``position_index``, the
        rows of the bank. It is in memory whole: of large fields predict some positions at a time.

    Raises
    ------
    InputError
        A file cannot be read, drive and bank do not fit, or a position does not exist or is not measured.

    Examples
    --------
    >>> import wavefocus as wf
    >>> field = wf.predict("drive.h5", "plate.h5", [3, 4])
    >>> field.field.shape, field.response_unit
    ((2, 4498), 'm/s')
    """
    from wavefocus.rendering.device import cuda_device
    from wavefocus.rendering.field.prediction import predict as predict_field

    if device != "cpu" and rate_hz is not None:
        raise InputError(f"device {device} does not go with rate_hz")
    played = _read(drive)
    with opened_bank(bank) as view:
        gpu = None if device == "cpu" else cuda_device()
        return predict_field(played, view, positions, dtype=dtype, rate_hz=rate_hz, device=gpu, on_progress=on_progress)


@checked
def focus_figures(
    drive: Drive | str | Path,
    bank: GreenSource | str | Path,
    field: Field | str | Path | None = None,
    *,
    on_progress: OnProgress | None = None,
) -> FocusResults:
    """Place, height, width and artefacts of a drive's foci.

    Parameters
    ----------
    drive
        A drive, or the path of a drive file; of more than 64 foci, 64 are looked at, evenly chosen.
    bank
        An open bank, an array of Green's functions, or the path of a bank.
    field
        The field to look at, or the path of a field file: predicted or scanned, at the drive's rate. By default the
        predicted field at all measured positions, computed at the focus instants alone.
    on_progress
        Called with the foci done and the foci in all.

    Returns
    -------
    FocusResults
        An array for each figure, a row per focus: ``source``, ``position``, ``time_s``, ``intended_mm``, ``at_mm``,
        ``peak``, ``off_mm``, ``width_mm`` and ``artefact_db``; NaN where a focus has none, or `field` lacks more than a
        tenth of the measured positions within 15 mm. Foci quieter than a quarter of the loudest are left out.

    Raises
    ------
    InputError
        A file cannot be read, or drive, bank and field do not belong together.

    Examples
    --------
    >>> import wavefocus as wf
    >>> foci = wf.focus_figures("drive.h5", "plate.h5")
    >>> len(foci), foci.intended_mm[0]
    (5, array([-10.,   0.]))
    """
    from wavefocus.rendering.field.foci import focus_figures as figures_of

    played = _read(drive)
    seen = read_field(field) if isinstance(field, str | Path) else field
    with opened_bank(bank) as view:
        return figures_of(played, view, seen, on_progress=on_progress)


@checked
def interpolate(
    bank: GreenSource | str | Path,
    places_mm: ArrayLike,
    *,
    method: str = "auto",
    frequency_hz: ArrayLike | None = None,
) -> Interpolated:
    """Green's functions at places between the bank's positions, with their errors.

    Parameters
    ----------
    bank
        An open bank, an array of Green's functions (`GreenArray`), or the path of a bank.
    places_mm
        Places (n, 2) in millimetres.
    method
        ``"nearest"``, ``"bilinear"``, ``"kernel"``, ``"waves"``, or ``"auto"``: the cheapest that serves, as in scenes.
    frequency_hz
        At which errors are stated; by default six over the bank's band.

    Returns
    -------
    Interpolated
        ``method``; ``green``, float64 (places, actuators, taps); ``frequency_hz``; ``expected_error`` and ``bound`` of
        the spectra there, (places, actuators, frequencies), absolute, in the bank's unit. ``bound_words`` says which
        share of random places the bound holds, or why it is NaN.

    Raises
    ------
    InputError
        The bank cannot be read, a place is off its grid, or it does not allow the method.

    Examples
    --------
    >>> import wavefocus as wf
    >>> found = wf.interpolate("plate.h5", [(-9.0, 0.5)], method="nearest")
    >>> found.green.shape, found.method
    ((1, 4, 1000), 'nearest')
    """
    from wavefocus.rendering.greens.interpolation.errors import interpolated

    with opened_bank(bank) as view:
        return interpolated(view, places_mm, method, frequency_hz)


@checked
def quiet_levels(drive: Drive | str | Path, bank: GreenSource | str | Path) -> tuple[QuietLevel, ...]:
    """Levels that a drive reaches at the quiet places that it was made with.

    Parameters
    ----------
    drive
        A drive, or the path of a drive file.
    bank
        An open bank, an array of Green's functions, or the path of a bank.

    Returns
    -------
    tuple of QuietLevel
        ``reached_db``, the energy of the predicted response there over that at the loudest focus, and ``track``, the
        place with the level asked for, ``level_db``; none of a drive without quiet places. Places of independent
        sources have the level of the other sources, as it was found while rendering.

    Raises
    ------
    InputError
        A file cannot be read, drive and bank do not fit, or a place is not on the bank's grid.

    Examples
    --------
    >>> import wavefocus as wf
    >>> tap = wf.Source(wf.Point((-10.0, 0.0)), wf.Noise((50.0, 450.0), 0.1))
    >>> finger = wf.QuietPlace(wf.Point((10.0, 0.0)), level_db=-10.0)
    >>> drive = wf.render(wf.Scene("tap", (tap,), quiet=(finger,)), "plate.h5")
    >>> [level] = wf.quiet_levels(drive, "plate.h5")
    >>> level.track.name, level.reached_db < -9
    ('quiet[0]', True)
    """
    from wavefocus.rendering.field.quiet_levels import quiet_levels as levels_of

    played = _read(drive)
    with opened_bank(bank) as view:
        return levels_of(played, view)


def _read(drive: Drive | str | Path) -> Drive:
    return read_drive(drive) if isinstance(drive, str | Path) else drive


@contextmanager
def naming(scene_file: str | Path, bank: GreenSource) -> Iterator[None]:
    """Name the scene file in an InputError that does not name the bank."""
    try:
        yield
    except InputError as wrong:
        names_bank = isinstance(bank, Bank) and str(bank.path) in str(wrong)
        raise InputError(str(wrong) if names_bank else f"{scene_file}: {wrong}") from None
