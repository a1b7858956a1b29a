"""``wavefocus publish``: a bank as a folder for a data repository."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import numpy as np

from wavefocus.campaign.blueprint import bank_configuration
from wavefocus.campaign.provenance import SessionRecord, devices_of, sessions_of
from wavefocus.config.run import Publication
from wavefocus.configuration import Configuration, publication_of
from wavefocus.console import progress, say, working_on
from wavefocus.crate import Crate, Part, published_files
from wavefocus.drivers.protocols import DeviceIdentity
from wavefocus.rendering.report.bank_pictures import green_over_time, quality_map, spectrum
from wavefocus.rendering.report.canvas import Picture, ReportSurface
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange import EXPORTS
from wavefocus.storage.exchange.exported_rows import choose_rows
from wavefocus.storage.output_files import replaced_folder, require_replaceable_folder
from wavefocus.storage.point_status import status_counts, usable

OUTLINE_POINTS = 400
_HOLDS = {
    "netcdf": "the Green's functions with places, status and quality; read by xarray and, as a bank, by wavefocus",
    "csv": "the positions: place, status, quality",
    "wav": "the Green's functions as sound files, with tables that describe them",
}


def publish(
    bank: Path, out: Path, to: str, *, publication: Path | None = None, force: bool = False, as_json: bool
) -> None:
    """Write exports of a bank with README, pictures, an RO-Crate's metadata and checksums into a new folder.

    to: Formats of the exports, with commas between them.
    force: Whether an older folder of this command is replaced; any other folder never is.

    Raises InputError: the bank cannot be read or does not fit a format, or the folder must stay.
    """
    formats = _formats(to)
    require_replaceable_folder(out, published_files(out), (bank, publication), by="publish", force=force)
    with open_bank(bank) as view:
        working_on("verifying the rows of the bank")
        view.require_sound()
        working_on("")
        about = publication_of(view, publication)
        measured_here = view.rig_json and view.run_json and view.plan_sha256
        configuration = bank_configuration(view) if measured_here else None
        with replaced_folder(out) as folder:
            parts = [*_exports(view, folder, formats, about), *_pictures(view, folder, configuration)]
            sessions = sessions_of(bank)
            _crate(view, about, configuration, parts, sessions).write(folder)
    if missing := [key for key in ("title", "licence", "people") if not getattr(about, key)]:
        say(f"not stated: {', '.join(missing)}; give them in [publication] of a TOML file, named with --publication")
    files = sorted(published_files(out))
    say(f"{out}: {len(files)} files, {sum((out / name).stat().st_size for name in files) / 1e6:.3g} MB")
    if as_json:
        print(json.dumps({"out": str(out), "files": files, "sessions": len(sessions)}))


def _formats(to: str) -> list[str]:
    formats = list(dict.fromkeys(part.strip() for part in to.split(",")))
    for one in formats:
        if one not in EXPORTS:
            raise InputError(f"--to: {one!r} is no format; allowed: {', '.join(EXPORTS)}, with commas between them")
    return formats


def _exports(view: Bank, folder: Path, formats: list[str], about: Publication) -> Iterator[Part]:
    stem = _stem(view)
    rows = choose_rows(view, None, missing_as_nan=False, publication=about.texts)
    for one in formats:
        form = EXPORTS[one]
        name = f"{stem}-{one}/" if form.folder else f"{stem}{form.suffix}"
        with progress(f"export to {one}", len(rows.row)) as report:
            import_module(form.module).write(folder / name, rows, report)
        yield Part(name, _HOLDS.get(one, f"the Green's functions as {form.title}"))


def _stem(view: Bank) -> str:
    """Name of the bank without its ending, as every system and repository takes it."""
    return re.sub(r"[^\w.-]+", "-", view.path.stem).strip("-.") or "bank"


def _pictures(view: Bank, folder: Path, configuration: Configuration | None) -> Iterator[Part]:
    outline_mm = configuration.rig.surface.outline.line(OUTLINE_POINTS) if configuration else None
    surface = ReportSurface.of(view, outline_mm=outline_mm)
    rows = np.flatnonzero(usable(view.status))
    places_mm = view.position_mm[rows]
    row = int(rows[np.argmin(np.hypot(*(places_mm - places_mm.mean(axis=0)).T))])
    green = view.green(row)
    actuator = int(np.argmax(np.square(green.astype(np.float64)).sum(axis=1)))
    x_mm, y_mm = view.position_mm[row]
    whose = f"from actuator {actuator} to position {row}, at ({x_mm:g}, {y_mm:g}) mm"

    def saved(picture: Picture, holds: str) -> Part:
        name = f"{picture.name}.png"
        (folder / name).write_bytes(picture.png)
        return Part(name, holds)

    picture = quality_map(surface, view.status, view.quality["snr_db"])
    yield saved(picture, "quality of each position; triangles are actuators")
    yield saved(green_over_time(green[actuator], view.sample_rate_hz, view.response_unit), f"Green's function {whose}")
    band = "; shaded: the measured band" if view.band_hz else ""
    yield saved(
        spectrum(green[actuator], view.sample_rate_hz, view.response_unit, view.band_hz),
        f"frequency response {whose}{band}",
    )


def _crate(
    view: Bank,
    about: Publication,
    configuration: Configuration | None,
    parts: list[Part],
    sessions: list[SessionRecord],
) -> Crate:
    measured = int(np.count_nonzero(usable(view.status)))
    description = about.description or (
        f"Green's functions of a plate, measured at {measured} positions with {view.actuators} actuators: FIR filters "
        f"of {view.taps} taps at {view.sample_rate_hz:g} Hz, in {view.response_unit}."
    )
    devices: dict[str, DeviceIdentity] = devices_of(configuration.rig, sessions) if configuration else {}
    return Crate(
        title=about.title or f"Green's functions of {_stem(view)}",
        description=description,
        publication=about,
        facts=[*_bank_facts(view, measured), *(_run_facts(configuration) if configuration else ())],
        parts=parts,
        devices=devices,
        sessions=sessions,
        software=view.software or "program of the bank, not stated",
        origin=str(view.import_facts.get("paragraph", "")),
    )


Fact = tuple[str, float | str, str]


def _bank_facts(view: Bank, measured: int) -> Iterator[Fact]:
    yield "measured positions", measured, ""
    for word, count in status_counts(view.status).items():
        if count and word != "valid":
            yield f"positions with status {word}", count, ""
    yield "actuators", view.actuators, ""
    yield "taps", view.taps, ""
    yield "sample rate", view.sample_rate_hz, "Hz"
    if view.band_hz is not None:
        yield "lowest measured frequency", view.band_hz[0], "Hz"
        yield "highest measured frequency", view.band_hz[1], "Hz"
    yield "unit of the Green's functions", view.response_unit, ""
    snr_db = view.quality["snr_db"][usable(view.status)]
    if np.isfinite(snr_db).any():
        yield "median signal-to-noise ratio", round(float(np.nanmedian(snr_db)), 2), "dB"


def _run_facts(configuration: Configuration) -> Iterator[Fact]:
    run, rig = configuration.run, configuration.rig
    if rig.is_virtual:
        yield "measured on", "the virtual rig: a simulation", ""
    yield "surface", rig.surface.kind, ""
    yield "duration of a sweep", run.sweep.duration_s, "s"
    yield "amplitude of the sweep", run.sweep.amplitude_v, "V"
    yield "sweeps per actuator and position", run.capture.averages, ""
    yield "excitation", run.capture.excitation, ""
    if rig.vibrometer.sensitivity_m_s_per_v is not None:
        yield "sensitivity of the vibrometer", rig.vibrometer.sensitivity_m_s_per_v, "m/s/V"
    if rig.calibration.measured is not None:
        yield "calibrated", rig.calibration.measured.made.date().isoformat(), ""
