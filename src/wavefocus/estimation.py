"""Green's functions from kept recordings, in Python and for ``wavefocus estimate``."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wavefocus.acquisition.judgement import judge
from wavefocus.acquisition.leak import mark_leaks
from wavefocus.banks import LOG, OnProgress
from wavefocus.calibration.estimator.estimate import bank_figures
from wavefocus.calibration.estimator.raw_estimation import PositionResult, affordable_workers, estimate_positions
from wavefocus.calibration.numerics import one_blas_thread
from wavefocus.campaign.blueprint import carried_configuration, estimator_for, own_plan, require_same_plan
from wavefocus.cluster import estimate_on_cluster
from wavefocus.config.run import QualityLimits
from wavefocus.configuration import check_rows, plate_behind
from wavefocus.storage.argument_types import checked
from wavefocus.storage.bank.layout import BankHeader, create_bank
from wavefocus.storage.bank.ledger import PointRecord, Status
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.durable import is_network_mount
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.header import RawHeader
from wavefocus.storage.raw.writer import RawFile, open_raw


@dataclass(frozen=True, slots=True)
class Estimated:
    """Status bits (positions,) of a bank, and how many positions were estimated into it, in which time."""

    status: NDArray[np.uint8]
    positions: int
    took_s: float
    faults: tuple[str, ...]


@checked
def estimate(
    raw: RawFile | str | Path,
    bank: str | Path,
    *,
    workers: int | None = None,
    on_progress: OnProgress | None = None,
) -> Bank:
    """Estimate the Green's functions of kept recordings into a bank, as ``wavefocus estimate``.

    Parameters
    ----------
    raw
        Open recordings, or the path of a raw file: of this program, or of any other (docs/reference/files.md).
    bank
        Path of the bank. One that is there must be of the same recordings; what it lacks is estimated.
    workers
        Positions that are estimated at a time; by default one per processor, as far as memory goes.
    on_progress
        Called with the positions done and the positions in all.

    Returns
    -------
    Bank
        Open for reading. Its status says which positions are valid.

    Raises
    ------
    InputError
        The recordings cannot be read, what was played cannot be found in them, or the bank is of others.

    Examples
    --------
    >>> import wavefocus as wf
    >>> with wf.estimate("plate.raw.h5", "again.h5") as bank:
    ...     print(bank.positions, bank.green(0).shape)
    15 (4, 1000)
    """
    show = on_progress or (lambda done, total: None)
    with open_raw(raw) if isinstance(raw, str | Path) else nullcontext(raw) as recordings:
        estimate_into(
            recordings, Path(bank), workers, report=LOG.info, watch=lambda what, total, **_: nullcontext(show)
        )
    return open_bank(bank)


def estimate_into(
    recordings: RawFile,
    bank: Path,
    workers: int | None,
    *,
    cluster: str = "",
    report: Callable[[str], None],
    watch: Callable[..., AbstractContextManager[Callable[[int, int], object]]],
) -> Estimated:
    """Estimate into a bank what it does not hold yet of a raw file; it is made where there is none.

    workers: Positions that are estimated at a time; by default one per processor.
    report: Receives lines about the recordings and what was found in them.
    watch: Shows progress, as `wavefocus.console.progress` does.

    Raises InputError: the excitation cannot be found, or the bank is not of these recordings.
    """
    header, raw = recordings.header, recordings.path
    with one_blas_thread():
        plan = own_plan(header, raw)
        limits = QualityLimits() if plan is None else plan.quality
        count = affordable_workers(header, workers or os.cpu_count() or 1, str(raw))
        if bank.exists() and bank.samefile(raw):
            raise InputError(f"--bank {bank}: is the raw file itself; name another file")

        def announce(line: str) -> None:
            report(f"{raw}: {line}")

        announce(
            f"{header.positions} positions, {header.records} records of {header.samples} samples at "
            f"{header.sample_rate_hz:g} Hz, {header.taps} taps"
            f"{'; finding what was played' if plan is None else ''}"
        )
        if not bank.exists():
            # The excitation must be found before a bank is made of it.
            estimator = estimator_for(recordings, plan, announce)
            if is_network_mount(bank.absolute().parent):
                report(f"{bank} is on a network drive, where locks and syncs are unreliable: estimate to a local disk")
            create_bank(bank, _bank_header(header))
        else:
            estimator = None
            if (configuration := carried_configuration(header, raw)) is not None:
                require_same_plan(bank, configuration, header.identity())
        with BankWriter.open(bank, plan_sha256=header.identity()) as writer:
            _require_alike(writer.header, header, bank, raw)
            to_do = np.flatnonzero(writer.status == 0).tolist()
            done = first = header.positions - len(to_do)
            if to_do and estimator is None:
                estimator = estimator_for(recordings, plan, announce)
            started_s = time.monotonic()
            faults: list[str] = []
            with watch("estimate", header.positions, done=first) as show:
                if to_do and estimator is not None:
                    results = (
                        estimate_on_cluster(cluster, raw, to_do)
                        if cluster
                        else estimate_positions(recordings, estimator, to_do, count)
                    )
                    for result in results:
                        leak_db = float(recordings.leak_db[result.position])
                        if fault := _commit(writer, result, limits, leak_db, calibrated=plan is not None):
                            faults.append(fault)
                        done += 1
                        show(done, header.positions)
            faults += mark_leaks(writer, header.response_per_volt)
            return Estimated(writer.status, done - first, time.monotonic() - started_s, tuple(faults))


def _commit(
    writer: BankWriter, result: PositionResult, limits: QualityLimits, leak_db: float, *, calibrated: bool
) -> str:
    """Keep one position; the sentence about it where it is not valid."""
    actuators, taps = writer.header.actuators, writer.header.taps
    found = result.estimate
    if found is None:
        record = PointRecord(int(Status.FAILED), 1, **bank_figures(None, actuators))
        writer.commit(result.position, np.zeros((actuators, taps), np.float32), record)
        return f"position {result.position} failed: {result.fault}"
    before_db = writer.reference_before_db(result.position)
    judgement = judge(found, False, limits, before_db=before_db, calibrated=calibrated)
    record = PointRecord(int(judgement.status), 1, **bank_figures(found, actuators), leak_db=leak_db)
    writer.commit(result.position, found.green, record)
    return "" if judgement.good else f"position {result.position}: {judgement.reason}"


def _bank_header(header: RawHeader) -> BankHeader:
    unit = header.response_unit
    found = carried_configuration(header, Path("raw recordings"))
    return BankHeader(
        sample_rate_hz=header.sample_rate_hz, taps=header.taps, band_hz=header.band_hz,
        position_mm=header.position_mm, actuator_mm=header.actuator_mm, rig_json=header.rig_json,
        run_json=header.run_json, plan_sha256=header.identity(),
        software=f"wavefocus {version('wavefocus')}, from raw recordings",
        response_unit=unit if unit.endswith("/V") else f"{unit}/V",
        directions_deg=None if found is None else plate_behind(found.rig, found.run).directions_deg,
        check_rows=() if found is None else tuple(check_rows(found).tolist()),
    )  # fmt: skip


def _require_alike(held: BankHeader, header: RawHeader, bank: Path, raw: Path) -> None:
    """Refuse a bank of other dimensions, whatever plan it names."""
    here = (held.positions, held.actuators, held.taps)
    wanted = (header.positions, header.actuators, header.taps)
    if here != wanted:
        raise InputError(
            f"{bank} holds {here[0]} positions, {here[1]} actuators and {here[2]} taps, {raw} {wanted[0]}, "
            f"{wanted[1]} and {wanted[2]}; name a new bank"
        )
