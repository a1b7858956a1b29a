"""Work spread over a dask cluster: parts in, results out in their order, a bounded number of them under way.

Workers open files by their path, once for all tasks, and hold BLAS to one thread, as every command does.
"""

import logging
import os
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration.estimator.estimate import PositionEstimator
from wavefocus.calibration.estimator.raw_estimation import PositionResult, estimate_positions
from wavefocus.calibration.numerics import one_blas_thread
from wavefocus.campaign.blueprint import estimator_for, own_plan
from wavefocus.console import say
from wavefocus.rendering.field.prediction import Prediction
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.drive_file import read_drive
from wavefocus.storage.errors import InputError, WavefocusError
from wavefocus.storage.raw.writer import RawFile, open_raw

Result = TypeVar("Result")

LOCAL = "local"
MAX_PROCESSES = 256
LOOKS_EVERY_S = 2.0
GIVES_UP_S = 60.0
"""Without a worker or a scheduler: another worker may join, a scheduler be slow."""
POSITIONS_AT_ONCE = 4
_PARTS_AT_ONCE = 4
"""In one task, which costs the scheduler some milliseconds."""


@contextmanager
def cluster_client(address: str) -> Iterator[Any]:
    """Connect to a cluster, or start one of processes on this machine.

    Raises InputError: dask is missing, no scheduler answers at the address, or a local cluster's number is none.

    Yields
    ------
    distributed.Client
    """
    local = address.partition(":")[0] == LOCAL
    workers = _processes(address) if local and ":" in address else os.cpu_count() or 1
    try:
        distributed: Any = import_module("distributed")  # types come with it, or not: it need not be there
    except ImportError as error:
        raise InputError(f"--cluster needs dask ({error}): pip install 'dask[distributed]'") from None
    with ExitStack() as opened:
        # What a lost connection makes dask log is another program's account; ours is one sentence.
        for name in logging.root.manager.loggerDict:
            if name.partition(".")[0] == "distributed":
                logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            if local:
                here = distributed.LocalCluster(
                    n_workers=workers, threads_per_worker=1, dashboard_address="127.0.0.1:0",
                    silence_logs=logging.CRITICAL,
                )  # fmt: skip
                where = opened.enter_context(here)
            else:
                where = address
            client = opened.enter_context(distributed.Client(where, timeout=20.0, set_as_default=False))
        except (OSError, ValueError, TimeoutError, RuntimeError) as error:
            what = "could not be started" if local else "no scheduler answers there"
            raise InputError(f"--cluster {address}: {what}: {error}") from None
        threads = sum(client.nthreads().values())
        if not threads:
            raise InputError(f"--cluster {address}: the scheduler there has no worker; start some with: dask worker")
        say(f"cluster {address}: {len(client.nthreads())} workers, {threads} threads")
        yield client


def _processes(address: str) -> int:
    wanted = address.partition(":")[2]
    if not (wanted.isascii() and wanted.isdigit() and 1 <= int(wanted) <= MAX_PROCESSES):
        raise InputError(f"--cluster {address}: local:N starts N processes here, 1 to {MAX_PROCESSES}")
    return int(wanted)


def spread(
    client: Any, function: Callable[..., Result], parts: Iterable[tuple[Any, ...]], *, stopped: str
) -> Iterator[Result]:
    """Carry out a function on the cluster with the arguments of every part, and give the results in the parts' order.

    Raises InputError: A worker raised it. Raises WavefocusError: workers were lost, again and again.
    """
    under_way: deque[Any] = deque()
    # One part is worked on, one waits.
    most = 2 * max(1, sum(client.nthreads().values()))
    try:
        for part in parts:
            under_way.append(client.submit(function, *part, pure=False))
            if len(under_way) >= most:
                yield _result(client, under_way.popleft(), stopped)
        while under_way:
            yield _result(client, under_way.popleft(), stopped)
    finally:
        if under_way:
            with suppress(Exception):  # of a scheduler that is gone
                client.cancel(list(under_way), force=True)


def estimate_on_cluster(address: str, raw: Path, positions: Sequence[int]) -> Iterator[PositionResult]:
    """Estimate positions on a cluster, in their order; each by itself, so that it is the same as here."""
    file = identity_of(raw)
    parts = [
        (file, list(positions[first : first + POSITIONS_AT_ONCE]))
        for first in range(0, len(positions), POSITIONS_AT_ONCE)
    ]
    with cluster_client(address) as client:
        for results in spread(client, _estimated_part, parts, stopped=f"estimating {raw}"):
            yield from results


def field_on_cluster(
    client: Any, drive: Path, bank: Path, rate_hz: float | None, parts: Iterable[Sequence[int]]
) -> Iterator[Any]:
    """Predict the parts of a field on a cluster, in their order; float32 arrays (rows, samples)."""
    files, chosen = (identity_of(drive), identity_of(bank)), [list(part) for part in parts]
    tasks = (
        (*files, rate_hz, chosen[first : first + _PARTS_AT_ONCE]) for first in range(0, len(chosen), _PARTS_AT_ONCE)
    )
    for fields in spread(client, field_parts, tasks, stopped=f"predicting {drive}"):
        yield from fields


def _result(client: Any, future: Any, stopped: str) -> Any:
    """A task's result, waited for as long as there is somebody to make it."""
    import distributed
    from distributed.comm.core import CommClosedError

    served_s = time.monotonic()
    while True:
        try:
            return future.result(timeout=LOOKS_EVERY_S)
        except WavefocusError:
            raise
        except distributed.KilledWorker:
            lost = "workers of the cluster were lost, again and again"
        except (distributed.CancelledError, CommClosedError):
            lost = "the scheduler of the cluster is gone"
        except (TimeoutError, distributed.TimeoutError):
            reached = client.status == "running"
            if reached and client.scheduler_info()["workers"]:
                served_s = time.monotonic()
            if time.monotonic() - served_s <= GIVES_UP_S:
                continue
            lost = "no worker of the cluster is left" if reached else "the scheduler of the cluster is gone"
        raise WavefocusError(f"{stopped}: {lost}; look at their logs, and start it again") from None


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


def _estimated_part(raw: Identity, positions: Sequence[int]) -> list[PositionResult]:
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
