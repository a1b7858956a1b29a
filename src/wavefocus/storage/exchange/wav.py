"""A bank as sound files, one multichannel WAV per position; exports and folders with a table are read."""

import hashlib
import json
import math
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import soundfile

from wavefocus.options import ImportOptions
from wavefocus.storage.bank.notes import notes_of
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.exported_rows import ExportedRows, OnProgress
from wavefocus.storage.exchange.measured import (
    Float64Array,
    Measured,
    distinct,
    require_honest,
    require_plain,
    stated_unit,
    with_z,
)
from wavefocus.storage.exchange.places import Place, coordinates, read_places, table
from wavefocus.storage.output_files import replaced_folder, require_room
from wavefocus.storage.text_file import read_regular, read_text, require_whole_sound

_MAX_CHANNELS = 1024
"""More than that is not a sound file for the library that writes them."""

TABLE_NAME, PLACES_NAME = "bank.json", "places.csv"
FORMAT = "wavefocus-wav-export"
_OURS = re.compile(r"(position|actuator)-\d+\.wav|places\.csv|bank\.json")


def write(folder: Path, rows: ExportedRows, on_progress: OnProgress | None = None) -> None:
    """Write a folder of WAV files (float32), with ``bank.json`` and ``places.csv`` that describe them.

    An older folder of that name is replaced as a whole. ``bank.json`` has the SHA-256 of each file.
    A file holds one position with a channel per actuator. All are divided by one power of two, so that nothing exceeds
    1 and the numbers of the bank come back exactly: value = sample * ``scale``.
    """
    bank = rows.bank
    if bank.actuators > _MAX_CHANNELS:
        raise InputError(
            f"{folder}: {bank.actuators} channels in a file are too many, {_MAX_CHANNELS} are allowed; use npz"
        )
    rate_hz = round(bank.sample_rate_hz)
    if rate_hz != bank.sample_rate_hz:
        raise InputError(f"{folder}: a WAV file has a whole rate, the bank has {bank.sample_rate_hz:.12g} Hz; use npz")
    if not rows.known.all():
        raise InputError(f"{folder}: sound files hold no NaN; leave missing positions out")
    scale = _scale(rows)
    facts = {
        "format": FORMAT,
        "scale": scale,
        "unit": rows.units[0],
        "drive_unit": bank.drive_unit,
        "band_hz": bank.band_hz,
        "publication": dict(rows.publication),
        "sample_rate_hz": rate_hz,
        "channels": "actuators",
        "position": rows.row.tolist(),
        "position_mm": rows.position_mm.tolist(),
        "status": rows.status.tolist(),
        "actuator_mm": [_known(place_mm) for place_mm in bank.actuator_mm],
    }
    with replaced_folder(folder) as staged:
        require_room(staged / TABLE_NAME, 4 * len(rows.row) * bank.actuators * bank.taps)
        files: list[dict[str, Any]] = []
        names = file_names(rows)[:-2]
        for name, (row, green) in zip(names, rows.each(on_progress), strict=True):
            checksum = _write(staged / name, green.T / scale, rate_hz)
            place_mm = bank.position_mm[row].tolist()
            files.append({"file": name, "sha256": checksum, "position": row, "position_mm": place_mm})
        (staged / PLACES_NAME).write_text(table(rows, "file", names), encoding="utf-8")
        (staged / TABLE_NAME).write_text(json.dumps({**facts, "files": files}, indent=1), encoding="utf-8")


def file_names(rows: ExportedRows) -> list[str]:
    """Names of the files: sound files in their order, then the tables."""
    width = len(str(rows.bank.positions - 1))
    return [*(f"position-{row:0{width}d}.wav" for row in rows.row.tolist()), PLACES_NAME, TABLE_NAME]


def older_files(folder: Path) -> set[str]:
    """Names of files in a folder that an earlier export wrote; empty where ``bank.json`` is not one of an export."""
    try:
        facts = json.loads(read_regular(folder / TABLE_NAME))
    except (OSError, ValueError, RecursionError):
        return set()
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        return set()
    return {file.name for file in folder.iterdir() if _OURS.fullmatch(file.name)}


def _scale(rows: ExportedRows) -> float:
    """A power of two that nothing exceeds."""
    peak = max(float(np.abs(green).max()) for _, green in rows.each())
    return float(2.0 ** math.ceil(math.log2(peak))) if peak > 0 else 1.0


@contextmanager
def sound_failures(path: Path) -> Iterator[None]:
    """Raise InputError with the file's name where the library that writes sounds fails."""
    try:
        yield
    except (soundfile.LibsndfileError, AssertionError) as error:  # the library asserts that all frames were written
        raise InputError(f"{path} cannot be written ({error or 'not all samples were written'})") from error


def _write(path: Path, samples: Any, rate_hz: int) -> str:
    """Write a file; returns its SHA-256."""
    with sound_failures(path):
        soundfile.write(path, samples.astype(np.float32), rate_hz, subtype="FLOAT", format="WAV")
    return _checksum_of(path)


def _checksum_of(path: Path) -> str:
    """SHA-256 of a file's content, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _known(place_mm: Any) -> list[float] | None:
    return [float(coordinate) for coordinate in place_mm] if np.isfinite(place_mm).all() else None


_Channels = list[tuple[str, int | None, int, int]]
"""File, channel from 0, or None of a file with one, and the pair (position, actuator) that it holds."""


def read(folder: Path, options: ImportOptions, stack: ExitStack) -> Measured:
    """Read a folder that our own export wrote, or one with a table of places, --places.

    The table has a line per file, or per channel (column ``channel``, from 1): ``file``, coordinates of the position,
    and ``actuator``, the actuator's name. Without that column the channels of a file are the actuators. Lines with the
    role ``actuator`` give their places.
    """
    exported = (folder / TABLE_NAME).is_file()
    measured = Measured((), (0, 0, 0), np.empty((0, 3)), np.empty((0, 3)))
    checksums, scale = dict[str, str](), 1.0
    if exported:
        channels, measured, checksums, scale = _exported(folder)
    if options.places is not None or not exported:
        channels, position_m, actuator_m = _listed(folder, options)
        measured = replace(measured, position_m=position_m, actuator_m=actuator_m, status=None)
    files: dict[str, list[tuple[int | None, int, int]]] = {}
    for file, channel, position, actuator in channels:
        files.setdefault(file, []).append((channel, position, actuator))
    shape = (len(measured.position_m), len(measured.actuator_m))
    paths = {name: _inside(folder, name) for name in files}
    for name in paths.keys() & checksums.keys():
        if _checksum_of(paths[name]) != checksums[name]:
            raise InputError(
                f"{paths[name]} is not the file that {TABLE_NAME} describes (sha256); export the bank again, or restore"
                " the folder"
            )
    infos = {name: _info(path) for name, path in paths.items()}
    rates = sorted({info.samplerate for info in infos.values()})
    if len(rates) > 1:
        raise InputError(f"{folder}: the files have rates from {rates[0]} to {rates[-1]} Hz; one rate is needed")
    kinds = sorted({info.subtype_info for info in infos.values()})
    samples = max(info.frames for info in infos.values())
    held = sum(path.stat().st_size for path in paths.values())
    require_honest(folder, "its sound", 4 * shape[0] * shape[1] * samples, held)
    green = np.full((*shape, samples), np.nan, np.float32)
    for name, held_by in files.items():
        info = infos[name]
        require_honest(paths[name], "its sound", 4 * info.frames * info.channels, paths[name].stat().st_size)
        sound, _ = soundfile.read(str(paths[name]), dtype="float32", always_2d=True)
        for channel, position, actuator in held_by:
            if channel is None and info.channels > 1:
                raise InputError(
                    f"{paths[name]} has {info.channels} channels; name one in the column 'channel', from 1"
                )
            if not 0 <= (channel or 0) < info.channels:
                raise InputError(f"{paths[name]} has {info.channels} channels, and {(channel or 0) + 1} is asked for")
            if not np.isnan(green[position, actuator, 0]):
                raise InputError(f"{paths[name]}: a second response of position {position} to actuator {actuator}")
            green[position, actuator, : len(sound)] = sound[:, channel or 0] * np.float32(scale)
            green[position, actuator, len(sound) :] = 0.0
    unverified = len(paths.keys() - checksums.keys()) if exported else 0
    partly = np.isnan(green[:, :, 0]).any(axis=1)
    green[partly] = np.nan
    without = f"{unverified} sound files without a checksum are those that {TABLE_NAME} describes"
    return replace(
        measured,
        rows=green,
        shape=(*shape, samples),
        sample_rate_hz=float(rates[0]),
        read=(f"{len(files)} sound files of up to {samples} samples ({', '.join(kinds)})",),
        assumed=(without,) if unverified else (),
        left_out=(f"{int(partly.sum())} positions without a response to every actuator",) if partly.any() else (),
    )


def _info(path: Path) -> Any:
    """What a sound file holds; raises InputError where it cannot be read, or is shorter than it says."""
    require_whole_sound(path)
    try:
        return soundfile.info(str(path))
    except soundfile.LibsndfileError as error:
        raise InputError(
            f"{path} is not read ({error.error_string.rstrip('.')}); convert it to a WAV file of PCM or 32-bit float"
            " samples"
        ) from None


def _exported(folder: Path) -> tuple[_Channels, Measured, dict[str, str], float]:
    """What our own export says of its files: channels, all but the sound, SHA-256 by file, factor on the samples."""
    table = folder / TABLE_NAME
    try:
        facts = json.loads(read_text(table))
    except (json.JSONDecodeError, RecursionError):
        facts = None
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        raise InputError(f"{table} does not describe exported sound files; name a CSV table with --places")
    per_position = facts["channels"] == "actuators"
    position_mm = np.array(facts["position_mm"], np.float64).reshape(-1, 2)
    known_mm = [place_mm or [np.nan, np.nan] for place_mm in facts["actuator_mm"]]
    actuator_mm = np.array(known_mm, np.float64).reshape(-1, 2)
    channels: _Channels = []
    for number, entry in enumerate(facts["files"]):
        for channel in range(len(actuator_mm) if per_position else len(position_mm)):
            pair = (number, channel) if per_position else (channel, number)
            channels.append((str(entry["file"]), channel, *pair))
    band = facts.get("band_hz")
    scale, status = float(facts["scale"]), np.array(facts["status"], np.int64)
    if not (math.isfinite(scale) and len(status) == len(position_mm) and np.isin(status, np.arange(32)).all()):
        raise InputError(f"{table} is damaged: its scale or status is none")
    measured = Measured(
        (),
        (0, 0, 0),
        with_z(position_mm / 1e3),
        with_z(actuator_mm / 1e3),
        stated_unit(str(facts["unit"]), str(facts.get("drive_unit", "")), table),
        band_hz=None if band is None else (float(band[0]), float(band[1])),
        status=status.astype(np.uint8),
        notes=notes_of(str((facts.get("publication") or {}).get("notes", ""))),
    )
    checksums = {str(entry["file"]): str(entry["sha256"]) for entry in facts["files"] if "sha256" in entry}
    return channels, measured, checksums, scale


def _listed(folder: Path, options: ImportOptions) -> tuple[_Channels, Float64Array, Float64Array]:
    """The files that a table of places names: channels, places of positions and of actuators in metres."""
    if options.places is None:
        raise InputError(
            f"{folder} needs a CSV table with --places: a line per sound file with the columns file,x_m,y_m[,z_m] and,"
            " of several actuators, actuator"
        )
    places = read_places(options.places, options)
    lines = [place for place in places if not place.is_actuator]
    position_of, position_m = distinct(coordinates(lines))
    named = {place.words.get("actuator", ""): place.m for place in places if place.is_actuator}
    names = list(dict.fromkeys([*named, *(line.words.get("actuator", "") for line in lines)]))
    number_of = {name: number for number, name in enumerate(names)}
    channels_of: dict[str, int] = {}
    channels: _Channels = []
    for line, position in zip(lines, position_of.tolist(), strict=True):
        name, word = line.words.get("file", ""), line.words.get("channel", "")
        if not name:
            raise InputError(f"{options.places}: line {line.line}: column 'file' is empty; a sound file is needed")
        if line.words.get("actuator"):
            channels.append((name, _channel(line, options), position, number_of[line.words["actuator"]]))
        elif word:
            channels.append((name, _channel(line, options), position, 0))
        else:
            if name not in channels_of:
                channels_of[name] = _info(_inside(folder, name)).channels
            channels += [(name, channel, position, channel) for channel in range(channels_of[name])]
    count = max(channel[3] for channel in channels) + 1
    unknown = np.full(3, np.nan)
    known = [named.get(name, unknown) for name in names] if any(names) else list(named.values())
    return channels, position_m, np.array([*known, *[unknown] * count][: max(count, len(named))])


def _channel(line: Place, options: ImportOptions) -> int | None:
    word = line.words.get("channel", "")
    if word and not (word.isdigit() and 1 <= int(word) <= _MAX_CHANNELS):
        raise InputError(f"{options.places}: line {line.line}: channel is {word!r}; 1 to {_MAX_CHANNELS} is needed")
    return int(word) - 1 if word else None


def _inside(folder: Path, name: str) -> Path:
    """A file of the folder, named without leaving it."""
    require_plain(name, folder, "a file name")
    path = folder / name
    if Path(name).is_absolute() or ".." in Path(name).parts or not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{folder}: file {name!r} lies outside the folder; only files inside it are read")
    if not path.is_file():
        raise InputError(f"{folder}: there is no file {name!r}")
    return path
