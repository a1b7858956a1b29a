"""A bank as sound files: one multichannel WAV per position, or per actuator."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
import soundfile

from rendering.drive.wav import sound_failures
from rendering.export.bank_rows import BankRows, OnProgress
from storage.errors import InputError
from storage.output_files import require_room, staged_folder

MOST_CHANNELS = 1024
"""More than that is not a sound file for the library that writes them."""

Per = Literal["position", "actuator"]
TABLE_NAME = "bank.json"


def write_sounds(folder: Path, rows: BankRows, per: Per, on_progress: OnProgress | None = None) -> Path:
    """Write WAV files (float32) into a folder, with a ``bank.json`` that says what they are.

    All are divided by one power of two, so that nothing exceeds 1 and the numbers of the bank come back exactly:
    value = sample * ``scale``.

    Parameters
    ----------
    folder : Path
        Where to; made when missing.
    rows : BankRows
        What to export. Per position, one row is in memory; per actuator, the whole bank.
    per : {"position", "actuator"}
        One file per position with a channel per actuator, or the other way round.
    on_progress : callable, optional
        Told rows done and rows in all.

    Returns
    -------
    Path
        The ``bank.json``.

    Raises
    ------
    InputError
        A file would have too many channels, the rate is no whole number, or rows are NaN.
    """
    bank = rows.bank
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
        "format": "wavefocus-wav-export",
        "scale": scale,
        "unit": bank.response_unit,
        "sample_rate_hz": rate_hz,
        "channels": "actuators" if per == "position" else "positions",
        "position": rows.row.tolist(),
        "position_mm": rows.position_mm.tolist(),
        "status": rows.status.tolist(),
        "actuator_mm": [_known(one) for one in bank.actuator_mm],
    }
    with staged_folder(folder, TABLE_NAME) as staged:
        require_room(staged / TABLE_NAME, 4 * len(rows.row) * bank.actuators * bank.taps)
        files: list[dict[str, Any]] = []
        names = sound_names(rows, per)
        if per == "position":
            for name, (row, green) in zip(names, rows.each(on_progress), strict=True):
                _write(staged / name, green.T / scale, rate_hz)
                files.append({"file": name, "position": row, "position_mm": bank.position_mm[row].tolist()})
        else:
            green = rows.green(np.float32, on_progress)
            for actuator, name in enumerate(names):
                _write(staged / name, green[:, actuator].T / scale, rate_hz)
                files.append({"file": name, "actuator": actuator, "actuator_mm": _known(bank.actuator_mm[actuator])})
        (staged / TABLE_NAME).write_text(json.dumps({**facts, "files": files}, indent=1), encoding="utf-8")
    return folder / TABLE_NAME


def sound_names(rows: BankRows, per: Per) -> list[str]:
    """Names of the sound files, in their order."""
    if per == "position":
        width = len(str(rows.bank.positions - 1))
        return [f"position-{row:0{width}d}.wav" for row in rows.row.tolist()]
    width = len(str(rows.bank.actuators - 1))
    return [f"actuator-{actuator:0{width}d}.wav" for actuator in range(rows.bank.actuators)]


def _scale(rows: BankRows) -> float:
    """A power of two that nothing exceeds."""
    peak = max(float(np.abs(green).max()) for _, green in rows.each())
    return float(2.0 ** math.ceil(math.log2(peak))) if peak > 0 else 1.0


def _write(path: Path, samples: Any, rate_hz: int) -> None:
    with sound_failures(path):
        soundfile.write(path, samples.astype(np.float32), rate_hz, subtype="FLOAT", format="WAV")


def _known(place_mm: Any) -> list[float] | None:
    return [float(one) for one in place_mm] if np.isfinite(place_mm).all() else None
