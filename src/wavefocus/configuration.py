"""From run and rig files to a validated configuration: the files, and all that they name, checked together."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from wavefocus.acquisition.grid import check_grid, read_positions_file, surface_grid
from wavefocus.calibration.mirror_map import MirrorMap
from wavefocus.config.calibration import load_calibration
from wavefocus.config.emulation import FINGER_MM, PlateKeys, plate_of
from wavefocus.config.loading import named_file, parse_toml, printable, read_toml, shown, validated
from wavefocus.config.rig import RigConfig, default_rig
from wavefocus.config.run import FaultFile, Publication, PublicationFile, RunConfig, Virtual
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.storage.bank.reading import Bank


@dataclass(frozen=True, slots=True)
class Configuration:
    """A run file and the rig that it names, checked together; `position_mm` (positions, 2) in measuring order."""

    run: RunConfig
    rig: RigConfig
    position_mm: NDArray[np.float64]

    @property
    def plan_sha256(self) -> str:
        """Hash of all that a resume must not change."""
        return plan_sha256(self.rig, self.run, self.position_mm)


def load_run(path: Path, text: str | None = None) -> Configuration:
    """Read a run file, the rig and the position list that it names.

    text: That of the run file, where it is not saved yet.

    Raises InputError: anything in the files is wrong, alone or against each other.
    """
    data = read_toml(path, "run") if text is None else parse_toml(text, str(path))
    if "settled" in data:
        raise InputError(
            f"{path}: settled: comes from the trial before a staggered campaign and stands in its bank alone"
        )
    if isinstance(data.get("grid"), dict) and "regular_positions" in data["grid"]:
        raise InputError(f"{path}: grid.regular_positions: is of banks of earlier versions alone")
    virtual = data.get("virtual")
    if isinstance(virtual, dict) and isinstance(virtual.get("fault_plan"), str):
        plan_file = named_file(path, "virtual.fault_plan", virtual["fault_plan"])
        faults = validated(FaultFile, read_toml(plan_file), str(plan_file))
        data["virtual"] = {**virtual, "fault_plan": faults.model_dump()["fault"]}
    run = validated(RunConfig, data, str(path))
    rig = default_rig() if run.rig_file(path) is None else load_rig(named_file(path, "rig", run.rig))
    position_mm = None
    if run.grid.positions_file is not None:
        positions_file = named_file(path, "grid.positions_file", run.grid.positions_file)
        position_mm = read_positions_file(positions_file, rig.surface.outline)
    return configuration_of(run, rig, position_mm, str(path))


def configuration_of(
    run: RunConfig, rig: RigConfig, position_mm: NDArray[np.float64] | None, source: str
) -> Configuration:
    """A run on a rig, checked together, at some positions or on the run's own grid.

    Raises InputError: the run cannot be carried out with the rig.
    """
    check_together(run, rig, source)
    if position_mm is None:
        try:
            grid = run.grid
            position_mm = surface_grid(rig.surface.outline, grid.margin_mm, grid.spacing_mm, grid.lattice)
            run = _with_check_count(run)
            checks_mm = _checks_mm(run, rig, position_mm)
            position_mm = np.concatenate([position_mm, checks_mm])
        except InputError as error:
            raise InputError(printable(f"{source}: grid.{error}")) from None
    _check_mirror_reach(rig, position_mm, source)
    return Configuration(run, rig, position_mm)


def _with_check_count(run: RunConfig) -> RunConfig:
    """The run with the number of check positions stated: 24 where the lattice is coarser than half a wavelength."""
    # Waves of a gel plate as in the paper: group velocity about 4.8 m/s.
    half_wavelength_mm = 0.5e3 * 4.8 / run.sweep.stop_hz
    if run.grid.check_positions is not None or run.grid.spacing_mm <= half_wavelength_mm:
        return run
    return run.model_copy(update={"grid": run.grid.model_copy(update={"check_positions": DEFAULT_CHECKS})})


def _checks_mm(run: RunConfig, rig: RigConfig, position_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    grid = run.grid
    count = grid.check_positions or 0
    if not count or grid.positions_file is not None:
        return np.zeros((0, 2))
    return check_grid(rig.surface.outline, grid.margin_mm, grid.spacing_mm, position_mm, count)


def check_rows(configuration: Configuration) -> NDArray[np.int64]:
    """Rows of the positions that are measured only to judge what is interpolated between the others."""
    run, rig = configuration.run, configuration.rig
    if not run.grid.check_positions or run.grid.positions_file is not None:
        return np.zeros(0, dtype=np.int64)
    grid = run.grid
    lattice_mm = surface_grid(rig.surface.outline, grid.margin_mm, grid.spacing_mm, grid.lattice)
    planned = {tuple(place) for place in _checks_mm(run, rig, lattice_mm).tolist()}
    rows = [row for row, place in enumerate(configuration.position_mm.tolist()) if tuple(place) in planned]
    return np.array(rows, dtype=np.int64)


DEFAULT_CHECKS = 24


def load_rig(path: Path, text: str | None = None) -> RigConfig:
    """Read a rig file.

    text: That of the rig file, where it is not saved yet.

    Raises InputError: anything in the file is wrong.
    """
    data = read_toml(path, "rig") if text is None else parse_toml(text, str(path))
    section = data.get("calibration")
    if isinstance(section, dict):
        if "measured" in section:
            raise InputError(f"{path}: calibration.measured: comes from the file that calibration.file names")
        if isinstance(section.get("file"), str):
            record = load_calibration(named_file(path, "calibration.file", section["file"]))
            data["calibration"] = {**section, "measured": record.model_dump()}
    recorder = data.get("recorder")
    if isinstance(recorder, dict):
        for key in ("tls_root", "tls_certificate", "tls_key"):
            if isinstance(recorder.get(key), str):
                # A bank holds the rig; it may be resumed from any folder.
                recorder[key] = str(named_file(path, f"recorder.{key}", recorder[key]).absolute())
    messages = data.get("messages")
    if isinstance(messages, dict) and isinstance(messages.get("alive_file"), str):
        messages["alive_file"] = str((path.parent / messages["alive_file"]).absolute())
    return validated(RigConfig, data, str(path))


def publication_of(bank: Bank, file: Path | None = None) -> Publication:
    """Read ``[publication]`` of a TOML file or, by default, of the run that a bank carries; empty where it has none.

    Raises InputError: the file has no table ``[publication]``, or anything in it is wrong.
    """
    if file is not None:
        data = read_toml(file)
        if "publication" not in data:
            raise InputError(printable(f"{file}: publication: is missing; a table [publication] is needed"))
        return validated(PublicationFile, {"publication": data["publication"]}, str(file)).publication
    if not (bank.run_json and bank.plan_sha256):  # of another program, which may mean something else by it
        return Publication()
    source = f"{bank.path}: attribute run"
    run = _from_json(bank.run_json, source)
    table = run.get("publication", {}) if isinstance(run, dict) else {}
    return validated(PublicationFile, {"publication": table}, source).publication


def named_rig(file: Path) -> RigConfig:
    """The rig of a file; the built-in virtual rig where the file is called ``virtual``.

    Raises InputError: anything in the file is wrong.
    """
    return default_rig() if str(file) == "virtual" else load_rig(file)


def configuration_from_json(
    rig_json: str, run_json: str, position_mm: NDArray[np.float64], source: str
) -> Configuration:
    """Read the configuration that a bank carries.

    Raises InputError: the texts are no configuration of this version.
    """
    rig_source, run_source = f"{source}: attribute rig", f"{source}: attribute run"
    rig = validated(RigConfig, _from_json(rig_json, rig_source), rig_source, kept=True)
    run = validated(RunConfig, _from_json(run_json, run_source), run_source, kept=True)
    check_together(run, rig, source)
    return Configuration(run, rig, position_mm)


def with_rig(configuration: Configuration, rig: RigConfig, source: str) -> Configuration:
    """Put another rig in the place of a configuration's own, checked against its run and grid.

    Raises InputError: the run cannot be carried out with it.
    """
    check_together(configuration.run, rig, source)
    _check_mirror_reach(rig, configuration.position_mm, source)
    return replace(configuration, rig=rig)


def plate_behind(rig: RigConfig, run: RunConfig) -> PlateKeys:
    """The plate that a run is measured on; of real instruments no more is known than that it is one."""
    return plate_of(run.virtual, rig.emulation) if rig.is_virtual else PlateKeys()


def check_together(run: RunConfig, rig: RigConfig, source: str) -> None:
    """Check run and rig against each other.

    Raises InputError: A virtual setting without a virtual rig, or a sweep that the wiring cannot carry.
    """
    if run.virtual is not None and not rig.is_virtual:
        raise InputError(f"{source}: virtual: is only for a virtual rig; {shown(run.rig)} has other drivers")
    plate = plate_behind(rig, run)
    table = "emulation" if plate is rig.emulation else "virtual"
    if plate.plate == "thin" and plate.gone is None and rig.surface.kind != "rectangle":
        raise InputError(f'{source}: {table}.plate = "thin": needs kind = "rectangle" in [surface] of the rig file')
    if plate.finger is not None and not rig.surface.outline.contains(plate.finger.place_mm, FINGER_MM):
        x_mm, y_mm = plate.finger.place_mm
        allowed = f"must be on the surface, {FINGER_MM:g} mm or more from its edge"
        raise InputError(f"{source}: {table}.finger.place_mm = [{x_mm:g}, {y_mm:g}]: {allowed}")
    if plate.plate == "stadium" and find_spec("skfem") is None:
        raise InputError(f'{source}: {table}.plate = "stadium": needs scikit-fem: pip install "wavefocus[plates]"')
    actuators = len(rig.actuators.position_mm)
    if run.capture.groups > actuators:
        allowed = f"must be at most {actuators}, the number of actuators"
        raise InputError(f"{source}: capture.groups = {run.capture.groups}: {allowed}")
    player, recorder, amplitude_v = rig.player, rig.recorder, run.sweep.amplitude_v
    weakest_v = min(player.output_full_scale_v[one] for one in (*player.channels, player.loopback_channel))
    loudest_v = recorder.reference_range_v / recorder.reference_gain
    rms_key, rms_v = player.rms_limit or ("", math.inf)
    for largest_v, allowed in (
        (player.limit_v, f"player.limit_v = {player.limit_v:g} of the rig"),
        (weakest_v, f"{weakest_v:g}, the full scale of the rig's weakest output"),
        (rms_v * 2**0.5, f"{rms_v * 2**0.5:.4g}, or its rms is beyond the rig's {rms_key}"),
        (loudest_v, f"{loudest_v:g} (the rig's recorder.reference_range_v / reference_gain)"),
    ):
        if amplitude_v > largest_v:
            raise InputError(f"{source}: sweep.amplitude_v = {amplitude_v:g}: must be at most {allowed}")


def _from_json(text: str, source: str) -> object:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(printable(f"{source}: not JSON: {error}")) from None


def _check_mirror_reach(rig: RigConfig, position_mm: NDArray[np.float64], source: str) -> None:
    try:
        angles = np.column_stack(MirrorMap(rig.mirror.matrix).angles_mrad(*position_mm.T))
    except InputError as error:
        raise InputError(f"{source}: grid: {error}; the rig's mirror.map must reach every position") from None
    beyond = np.flatnonzero(~(np.abs(angles).max(axis=1) <= rig.mirror.limit_mrad))
    if len(beyond):
        row = int(beyond[0])
        (x_mm, y_mm), (x_mrad, y_mrad) = position_mm[row], angles[row]
        raise InputError(
            f"{source}: grid: position {row} at ({x_mm:g}, {y_mm:g}) mm needs mirror angles of "
            f"({x_mrad:.1f}, {y_mrad:.1f}) mrad; the rig's mirror.limit_mrad = {rig.mirror.limit_mrad:g}"
        )


def plan_sha256(rig: RigConfig, run: RunConfig, position_mm: NDArray[np.float64]) -> str:
    """Hash all that a resume must not change, so that no bank mixes two plans.

    Every key of rig and run counts that is not marked `FREE` where its table is defined. Free are names, file paths,
    addresses, ports, device names, safety limits, settling time, time-outs, verification tolerances, fault plans and
    what an emulation is like: they can change without making the rows of one bank differ in kind.

    Returns 64 hexadecimal digits: SHA-256 of canonical JSON.
    """
    hashed = _hashed_keys(rig, run, position_mm)
    text = json.dumps(hashed, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


class Difference(NamedTuple):
    """A key that a resume must not change, as ``recorder.response_range_v``, and its two values as a file has them."""

    key: str
    own: str
    other: str

    def __str__(self) -> str:
        return f"{self.key} ({self.own}, not {self.other})"


def plan_differences(own: Configuration, other: Configuration) -> tuple[Difference, ...]:
    """Keys that a resume must not change and in which two configurations differ; empty where their hashes agree."""
    mine, theirs = (dict(_leaves("", _hashed_keys(one.rig, one.run, one.position_mm))) for one in (own, other))
    keys = [key for key in {**mine, **theirs} if mine.get(key, _ABSENT) != theirs.get(key, _ABSENT)]
    return tuple(Difference(key, _value(mine, key), _value(theirs, key)) for key in keys)


_ABSENT = object()


def _value(leaves: Mapping[str, object], key: str) -> str:
    value = leaves.get(key, _ABSENT)
    if key == "position_mm" and isinstance(value, list):
        return f"{len(value)} positions from {shown(value[:1])} to {shown(value[-1:])}"
    return "the default" if value is _ABSENT else "none" if value is None else shown(value)


def _leaves(name: str, value: object) -> Iterator[tuple[str, object]]:
    if isinstance(value, dict):
        for key, beneath in value.items():
            yield from _leaves(f"{name}.{key}" if name else str(key), beneath)
    else:
        yield name, value


def _hashed_keys(rig: RigConfig, run: RunConfig, position_mm: NDArray[np.float64]) -> dict[str, object]:
    hashed = {**rig.plan_values(), **run.plan_values()}
    hashed |= {"position_mm": (position_mm + 0.0).tolist(), "actuator_mm": rig.actuators.position_mm, "virtual": None}
    if rig.is_virtual:
        flaws = {} if rig.emulation.is_flawless else {"emulation": rig.emulation.plan_values()}
        hashed["virtual"] = (run.virtual or Virtual()).plan_values() | flaws
    return hashed
