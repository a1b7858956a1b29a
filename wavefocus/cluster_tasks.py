"""What a worker of a cluster does: some rows of a field, some positions of raw recordings.

Workers open files by their path, once for all tasks, and hold BLAS to one thread, as every command does.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.blas import one_blas_thread
from calibration.estimator.estimate import PositionEstimator
from calibration.estimator.raw_estimation import PositionResult, estimate_positions
from rendering.field.prediction import Prediction
from storage.bank.reading import open_bank
from storage.drive_file import read_drive
from storage.errors import InputError
from storage.raw.reading import RawFile, open_raw
from wavefocus.campaign.blueprint import estimator_for, own_plan

Identity = tuple[str, int, int]
"""A file as all machines must see it: path, bytes, when it was changed last in ns."""


def identity_of(path: Path) -> Identity:
    """A file's identity, to be compared on another machine."""
    facts = path.stat()
    return str(path.absolute()), facts.st_size, facts.st_mtime_ns


def field_parts(
    drive: Identity, bank: Identity, rate_hz: float | None, parts: Sequence[Sequence[int]]
) -> list[NDArray[np.float32]]:
    """Predict some parts of a field, each computed as one, and rounded once to the float32 of its file.

    Raises InputError: this machine does not have the files.
    """
    prediction = _prediction(_here(drive), _here(bank), rate_hz)
    return [prediction.respond(np.asarray(part, dtype=np.int64)).astype(np.float32) for part in parts]


def estimated_part(raw: Identity, positions: Sequence[int]) -> list[PositionResult]:
    """Estimate some positions of raw recordings.

    Raises InputError: this machine does not have the file, or recordings in it cannot be used.
    """
    recordings, estimator = _recordings(_here(raw))
    with one_blas_thread():
        return list(estimate_positions(recordings, estimator, positions, 1))


def _here(file: Identity) -> Identity:
    path = Path(file[0])
    if not path.exists():
        raise InputError(f"cluster worker {_name()}: {path} does not exist there; workers need the same files by path")
    if identity_of(path)[1] != file[1]:
        raise InputError(f"cluster worker {_name()}: {path} is another file there, it has {path.stat().st_size} bytes")
    return file


def _name() -> str:
    return f"{socket.gethostname()} (process {os.getpid()})"


# One scene and one bank at a time; the next one takes its place. A bank that is dropped closes its file.
@lru_cache(maxsize=1)
def _prediction(drive: Identity, bank: Identity, rate_hz: float | None) -> Prediction:
    dtype = np.float64 if rate_hz is None else np.float32
    return Prediction(read_drive(drive[0]), open_bank(bank[0]), (), dtype=dtype, rate_hz=rate_hz)


@lru_cache(maxsize=1)
def _recordings(raw: Identity) -> tuple[RawFile, PositionEstimator]:
    recordings = open_raw(raw[0])
    with one_blas_thread():
        return recordings, estimator_for(recordings, own_plan(recordings.header, Path(raw[0])))
