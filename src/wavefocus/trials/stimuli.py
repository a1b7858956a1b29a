"""Drives of all stimuli of an experiment, rendered, held against limits, and hashed before the first person arrives."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from wavefocus.config.loading import printable
from wavefocus.config.scene import Output
from wavefocus.rendering.drive.coil_limits import DriveLimits, levels_of, peaks, strictest
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.drive.wav import Interface
from wavefocus.rendering.report.render_report import RenderReport
from wavefocus.rendering.scene.model import Scene
from wavefocus.storage.bank.reading import Bank
from wavefocus.storage.drive_file import Drive, read_drive, write_drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.hdf5_digest import values_sha256
from wavefocus.storage.output_files import require_output_folder, write_whole
from wavefocus.storage.text_file import read_text
from wavefocus.storage.units import PLAYED_UNITS
from wavefocus.trials.design import FACTORS, Stimulus, TrialsDesign

FOLDER, MANIFEST = "stimuli", "manifest.json"
FORMAT = "wavefocus-stimuli"


@dataclass(frozen=True, slots=True)
class Prepared:
    """Stimuli of an experiment on disk.

    folder: Folder of the manifest and of the drive files, NAME.h5.
    bank_sha256: SHA-256 of the bank file's bytes.
    sha256: Of each stimulus' drive, by name: the attribute ``sha256`` of ``/drive`` (docs/reference/files.md).
    warnings: Warnings of what was rendered just now, one sentence each.
    """

    folder: Path
    bank_sha256: str
    sha256: Mapping[str, str]
    warnings: tuple[str, ...] = ()

    def drive(self, name: str) -> Drive:
        """Read the drive of a stimulus. Raises InputError: its file is missing, damaged or holds another drive."""
        file = self.folder / f"{name}.h5"
        drive = read_drive(file)
        if values_sha256(drive.drive_v) != self.sha256[name]:
            raise InputError(f"{file}: holds another drive than {MANIFEST} lists; restore the file")
        return drive


def prepare(
    design: TrialsDesign,
    bank: Bank,
    folder: Path,
    *,
    limits: DriveLimits,
    interface: Interface,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    anew: bool = False,
) -> Prepared:
    """Render all stimuli that are not in `folder`/stimuli yet, and verify those that are.

    A drive is that of amplitude 1 times the stimulus' amplitude, so that a ladder of amplitudes is rendered once. It is
    never scaled down to a limit, which would change the experiment.

    limits: Of the design's table [output] or of the rig, whichever is stricter.
    interface: Outputs of the rig's actuators.
    on_progress: Called with stimuli done and stimuli in all.
    anew: Whether stimuli of another trials file or bank are removed first: where nobody has answered yet.

    Raises InputError: the bank does not cover a path, does not fit the rig or takes no volts; a drive is beyond a
    limit; the folder holds stimuli of another trials file or bank, damaged ones, or such as are rendered otherwise now.
    """
    if bank.drive_unit not in PLAYED_UNITS:
        raise InputError(f"{bank.path}: takes drives in {bank.drive_unit}, and the player plays volts")
    if bank.actuators != len(interface.full_scale_v):
        raise InputError(f"{bank.path}: has {bank.actuators} actuators, the rig {len(interface.full_scale_v)}")
    with bank.path.open("rb") as file:
        bank_sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    place = folder / FOLDER
    origin = {"format": FORMAT, "trials_sha256": design.sha256, "bank_sha256": bank_sha256}
    listed = _listed(design, bank, place, origin, anew=anew)
    before = Prepared(place, bank_sha256, {name: entry["sha256"] for name, entry in listed.items()})
    renderer = _renderer(bank, design, place, before)
    entries: dict[str, Any] = {}
    for done, (name, stimulus) in enumerate(design.stimuli.items()):
        on_progress(done, len(design.stimuli))
        path = place / f"{name}.h5"
        there = name in listed and path.exists()
        try:
            drive = before.drive(name) if there else renderer.drive(stimulus)
            _check_limits(drive, stimulus, limits, interface)
        except InputError as error:
            text = str(error)
            about = "" if text.startswith(str(path)) else f"{design.file}: stimulus {name}: "
            raise InputError(printable(about + text)) from None
        entries[name] = _entry(stimulus, drive) if not there else listed[name]
        if name in listed and entries[name]["sha256"] != listed[name]["sha256"]:
            raise InputError(f"{path}: is missing, and is rendered otherwise now than {MANIFEST} lists; restore it")
        if not there:
            write_drive(path, drive, force=True)
    on_progress(len(design.stimuli), len(design.stimuli))
    if entries != listed:
        _write_manifest(place, origin, entries)
    return Prepared(place, bank_sha256, {name: entry["sha256"] for name, entry in entries.items()}, renderer.warnings())


def _renderer(bank: Bank, design: TrialsDesign, place: Path, before: Prepared) -> _Renderer:
    """Render as the stimuli that are listed: an earlier version took "nearest" where a design names nothing."""
    names = [name for name in before.sha256 if design.stimuli[name].amplitude]
    if names and not all((place / f"{name}.h5").exists() for name in design.stimuli):
        stimulus, renderer = design.stimuli[names[0]], _Renderer(bank, earlier=True)
        if values_sha256(renderer.drive(stimulus).drive_v) == before.sha256[stimulus.name]:
            return renderer
    return _Renderer(bank)


class _Renderer:
    """Renders stimuli; of those that differ only in amplitude and follow each other, only the first."""

    def __init__(self, bank: Bank, *, earlier: bool = False) -> None:
        self._earlier = earlier
        self._of_warning: dict[str, list[str]] = {}
        self._bank = bank
        self._last: tuple[Scene, Drive, RenderReport] | None = None

    def warnings(self) -> tuple[str, ...]:
        """Each warning once, with the stimuli that it is about."""
        return tuple(
            f"{'stimulus' if len(names) == 1 else 'stimuli'} {', '.join(names)}: {text}"
            for text, names in self._of_warning.items()
        )

    def drive(self, stimulus: Stimulus) -> Drive:
        assert stimulus.scene is not None  # of a trials file
        (source,) = stimulus.scene.sources
        wanted = ((self._earlier and stimulus.scene.of_earlier_versions) or stimulus.scene).output
        output = Output(interpolation=wanted.interpolation, most_energy=wanted.most_energy)
        scene = replace(stimulus.scene, name="", sources=(replace(source, amplitude=1.0),), output=output)
        if self._last is None or self._last[0] != scene:
            self._last = scene, *render_with_report(scene, self._bank)
        _, drive, report = self._last
        for text in report.warnings if stimulus.amplitude else ():
            self._of_warning.setdefault(text, []).append(stimulus.name)
        with np.errstate(over="ignore"):
            return replace(drive, drive_v=drive.drive_v * stimulus.amplitude)


def _check_limits(drive: Drive, stimulus: Stimulus, limits: DriveLimits, interface: Interface) -> None:
    # As if plays and trials followed each other without a pause.
    levels = levels_of(drive.drive_v, drive.sample_rate_hz, repeated=True, limits=limits).against(limits)
    between = interface.reached(interface.between_v(drive.drive_v, drive.sample_rate_hz))
    limiting = strictest([between, *levels])
    if limiting.decided_by is not None:
        raise InputError(
            f"actuator {limiting.actuator} would reach {limiting.reached_v:.4g} V, more than {limiting.decided_by} ="
            f" {limiting.limit_v:g} V; stimuli are not scaled down: give it an amplitude of"
            f" {abs(stimulus.amplitude) * limiting.scale * 0.995:.3g} or less"
        )


def _entry(stimulus: Stimulus, drive: Drive) -> dict[str, Any]:
    """What the manifest says of a stimulus."""
    return {
        **{factor: getattr(stimulus, factor) for factor in FACTORS},
        "plays": stimulus.plays,
        "seconds": drive.drive_v.shape[1] / drive.sample_rate_hz,
        "peak_v": float(peaks(drive.drive_v).max()),
        "sha256": values_sha256(drive.drive_v),
    }


def _listed(
    design: TrialsDesign, bank: Bank, place: Path, origin: Mapping[str, Any], *, anew: bool
) -> dict[str, dict[str, Any]]:
    """Stimuli of the manifest; where there is none it is begun, empty, so that the folder's files have an origin."""
    path = place / MANIFEST
    if not path.exists():
        require_output_folder(place, [MANIFEST, *(f"{name}.h5" for name in design.stimuli)], (bank.path,), force=False)
        try:
            place.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(printable(f"{place}: cannot be written: {error.strerror}")) from None
        _write_manifest(place, origin, {})
        return {}
    try:
        manifest = json.loads(read_text(path))
        listed = {name: dict(manifest["stimuli"][name]) for name in manifest["stimuli"]}
        hashes = [entry["sha256"] for entry in listed.values()]
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: is damaged; restore it") from None
    if manifest.get("format") != FORMAT or not all(isinstance(text, str) for text in hashes):
        raise InputError(f"{path}: is not a list of stimuli; restore it")
    if anew and any(manifest.get(key) != value for key, value in origin.items()):
        for file in place.glob("*.h5"):
            file.unlink()
        _write_manifest(place, origin, {})
        return {}
    for key, what in (("trials_sha256", design.file), ("bank_sha256", bank.path)):
        if manifest.get(key) != origin[key]:
            made = f"{path}: its stimuli were made before {what} was changed, or from another one"
            raise InputError(printable(f"{made}; restore it, or choose another folder with --out"))
    return {name: entry for name, entry in listed.items() if name in design.stimuli}


def _write_manifest(place: Path, origin: Mapping[str, Any], entries: Mapping[str, Any]) -> None:
    software = f"wavefocus {version('wavefocus')}"
    text = json.dumps({**origin, "format_version": 1, "software": software, "stimuli": entries}, indent=2)
    write_whole(place / MANIFEST, text + "\n")
