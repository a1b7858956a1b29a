"""A bank as sound files: one multichannel WAV per position, or per actuator."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import soundfile

from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.bank_rows import BankRows, OnProgress
from wavefocus.storage.exchange.places import table
from wavefocus.storage.output_files import replaced_folder, require_room
from wavefocus.storage.text_file import read_regular

MOST_CHANNELS = 1024
"""More than that is not a sound file for the library that writes them."""

TABLE_NAME, PLACES_NAME = "bank.json", "places.csv"
FORMAT = "wavefocus-wav-export"
_OURS = re.compile(r"(position|actuator)-\d+\.wav|places\.csv|bank\.json")


def write(folder: Path, rows: BankRows, on_progress: OnProgress | None = None) -> None:
    """Write a folder of WAV files (float32), with ``bank.json`` and ``places.csv`` that describe them.

    An older folder of that name is replaced as a whole. ``bank.json`` has the SHA-256 of each file.
    A file holds one position with a channel per actuator, or the other way round, as `rows.per` says; per actuator the
    whole bank is in memory. All are divided by one power of two, so that nothing exceeds 1 and the numbers of the bank
    come back exactly: value = sample * ``scale``.
    """
    bank, per = rows.bank, rows.per
    channels = bank.actuators if per == "position" else len(rows.row)
    if channels > MOST_CHANNELS:
        raise InputError(
            f"{folder}: {channels} channels in a file are too many, {MOST_CHANNELS} are allowed; export some"
            " --positions at a time, or one file per position"
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
        "channels": "actuators" if per == "position" else "positions",
        "position": rows.row.tolist(),
        "position_mm": rows.position_mm.tolist(),
        "status": rows.status.tolist(),
        "actuator_mm": [_known(one) for one in bank.actuator_mm],
    }
    with replaced_folder(folder) as staged:
        require_room(staged / TABLE_NAME, 4 * len(rows.row) * bank.actuators * bank.taps)
        files: list[dict[str, Any]] = []
        names = file_names(rows)[:-2]
        if per == "position":
            for name, (row, green) in zip(names, rows.each(on_progress), strict=True):
                checksum = _write(staged / name, green.T / scale, rate_hz)
                place_mm = bank.position_mm[row].tolist()
                files.append({"file": name, "sha256": checksum, "position": row, "position_mm": place_mm})
        else:
            green = rows.green(np.float32, on_progress)
            for actuator, name in enumerate(names):
                checksum = _write(staged / name, green[:, actuator].T / scale, rate_hz)
                place = {"actuator": actuator, "actuator_mm": _known(bank.actuator_mm[actuator])}
                files.append({"file": name, "sha256": checksum, **place})
        first = ("file", names) if per == "position" else ("channel", range(len(rows.row)))
        (staged / PLACES_NAME).write_text(table(rows, *first), encoding="utf-8")
        (staged / TABLE_NAME).write_text(json.dumps({**facts, "files": files}, indent=1), encoding="utf-8")


def file_names(rows: BankRows) -> list[str]:
    """Names of the files: sound files in their order, then the tables."""
    if rows.per == "position":
        width = len(str(rows.bank.positions - 1))
        return [*(f"position-{row:0{width}d}.wav" for row in rows.row.tolist()), PLACES_NAME, TABLE_NAME]
    width = len(str(rows.bank.actuators - 1))
    return [*(f"actuator-{actuator:0{width}d}.wav" for actuator in range(rows.bank.actuators)), PLACES_NAME, TABLE_NAME]


def older_files(folder: Path) -> set[str]:
    """Names of files in a folder that an earlier export wrote; empty where ``bank.json`` is not one of an export."""
    try:
        facts = json.loads(read_regular(folder / TABLE_NAME))
    except (OSError, ValueError, RecursionError):
        return set()
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        return set()
    return {file.name for file in folder.iterdir() if _OURS.fullmatch(file.name)}


def _scale(rows: BankRows) -> float:
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
    return checksum_of(path)


def checksum_of(path: Path) -> str:
    """SHA-256 of a file's content, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _known(place_mm: Any) -> list[float] | None:
    return [float(one) for one in place_mm] if np.isfinite(place_mm).all() else None
