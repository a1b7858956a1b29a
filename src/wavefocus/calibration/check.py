"""Checks of finished files: checksums, physical sanity, rows against their neighbours."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration import BoolArray, Float64Array
from wavefocus.calibration.crosstalk import REMEDY, SPARE, leak_limit, response_per_volt
from wavefocus.calibration.estimator.noise_error import bank_noise_error_db
from wavefocus.calibration.evidence import SILENT, SOUND
from wavefocus.calibration.neighbour_judge import RowsAtFrequencies, judge_rows
from wavefocus.calibration.numerics import one_blas_thread
from wavefocus.storage.bank.layout import rows_off_grid
from wavefocus.storage.bank.ledger import DOUBTFUL, Status, median_of_pairs, row_ranges, usable
from wavefocus.storage.bank.reading import Bank, LedgerRows, open_bank
from wavefocus.storage.drive_file import FORMAT as DRIVE
from wavefocus.storage.drive_file import read_drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import FORMAT as FIELD
from wavefocus.storage.field_file import FieldRowReader
from wavefocus.storage.hdf5_digest import format_of
from wavefocus.storage.ledger.owner import bank_owner, owner_path
from wavefocus.storage.ledger.reader import LedgerReader
from wavefocus.storage.raw.header import RAW
from wavefocus.storage.raw.writer import RawRows, open_raw

_TENTHS = 10
ONE_AVERAGE = (
    "one sweep per record: a gain that changes, lost samples and a response longer than its taps cannot be told from"
    " noise; with capture.averages of 2 or more they can"
)
# Fewer positions are not a grid.
_NEIGHBOURHOOD = 9


@dataclass(frozen=True, slots=True)
class BankProblem:
    """One thing that is wrong with a bank.

    position: The position it is about; None for the whole bank.
    actuator: The actuator it is about; None for all of them.
    message: What is wrong, as one sentence.
    severity: ``"error"`` when the data cannot be trusted, ``"warning"`` when a person should look, ``"note"`` for the
        extent of the check itself, and for the error that white noise leaves.
    """

    position: int | None
    actuator: int | None
    message: str
    severity: Literal["error", "warning", "note"] = "error"


def check_bank(path: str | Path) -> list[BankProblem]:
    """Check every row of a bank.

    path: A bank of this program or of another; while a run is on, what is just being written is not held against it.

    Returns list of Finding: nothing but notes when all is well. Raises InputError: when the file cannot be opened as a
    bank at all.
    """
    path = Path(path)
    with open_bank(path, contents=True) as bank, one_blas_thread():
        rows = _rows_in_place(bank)
        found = [] if rows is None else list(_check_ledger(rows, path))
        checks = (_check_file, _check_positions, _check_moved, _check_suspects, _check_rows, _check_leak, _note_noise)
        for check in (*checks, _check_averages):
            found += check(bank)
    return sorted(found, key=lambda one: -1 if one.position is None else one.position)


def _check_ledger(rows: LedgerReader, path: Path) -> Iterator[BankProblem]:
    """Check that what follows from the ledger of a bank or raw file agrees with it, and that no crash waits for repair.

    Nothing is found while a process writes the file.
    """
    if bank_owner(path) is not None:
        return
    # Only a writer that did not come to its end leaves its name; what it cut off is not damage.
    cut_off: Literal["error", "warning"] = "warning" if owner_path(path).exists() else "error"
    state = rows.journal_state()
    if state == "whole":
        yield BankProblem(None, None, "a replacement was cut off; opening the file to resume finishes it", "warning")
    elif state == "torn":
        message = "the journal is damaged, or a crash cut it off; opening the file to resume clears it"
        yield BankProblem(None, None, message, cut_off)
    for position in np.flatnonzero(rows.ledger.damaged).tolist():
        message = f"the ledger row of position {position} is damaged; it has to be measured again"
        yield BankProblem(position, None, message)
    for position in rows.torn():
        message = (
            f"position {position} holds values and its ledger row is empty; a crash cut it off, or it is damaged;"
            " resume measures it again"
        )
        yield BankProblem(position, None, message, cut_off)
    if isinstance(rows, LedgerRows | RawRows):
        names = "/status or /quality" if isinstance(rows, LedgerRows) else "/leak_db"
        for position in np.flatnonzero(rows.differing() & ~rows.ledger.damaged).tolist():
            message = f"{names} of position {position} differ from the ledger; opening the file to resume rebuilds them"
            yield BankProblem(position, None, message, cut_off)


def _rows_in_place(bank: Bank) -> LedgerRows | None:
    """Rows that lie in the file as this program laid it out; None in a copied bank, and in one of another program."""
    return bank.rows if isinstance(bank.rows, LedgerRows) and not bank.rows.is_copied else None


def _check_file(bank: Bank) -> Iterator[BankProblem]:
    if not isinstance(bank.rows, LedgerRows):
        yield _unverified("its rows are unverified")
    elif bank.rows.is_copied:
        message = (
            "the bank was copied object by object, or repacked: header and rows are verified, all else is not; it can "
            "be read, and not measured into"
        )
        yield BankProblem(None, None, message, "warning")
    if bank.unknown_attributes:
        named = ", ".join(bank.unknown_attributes[:MAX_NAMES])
        yield BankProblem(None, None, f"attributes that somebody has added are not looked at: {named}", "note")


MAX_NAMES = 10


def _note_noise(bank: Bank) -> Iterator[BankProblem]:
    error_db = bank_noise_error_db(bank)
    median_db = median_of_pairs(error_db, bank.status)
    if error_db is None or median_db is None:
        return
    known_db = np.where((bank.status > 0)[:, np.newaxis] & np.isfinite(error_db), error_db, -np.inf)
    hidden = known_db >= 0
    heard_db = np.where(hidden, -np.inf, known_db)
    position, actuator = (int(at) for at in np.unravel_index(np.argmax(heard_db), heard_db.shape))
    message = f"white noise leaves an error of {median_db:.1f} dB in the median row"
    if np.isfinite(heard_db).any():
        worst = "worst that it does not hide" if hidden.any() else "worst"
        message += (
            f", of {heard_db[position, actuator]:.1f} dB in the {worst} (position {position}, actuator {actuator})"
        )
    if hidden.any():
        position, actuator = (int(at) for at in np.argwhere(hidden)[0])
        message += f"; rows that it hides: {int(hidden.sum())} (the first: position {position}, actuator {actuator})"
    yield BankProblem(None, None, message, "note")


def _check_positions(bank: Bank) -> Iterator[BankProblem]:
    _, first, group = np.unique(bank.position_mm, axis=0, return_index=True, return_inverse=True)
    for position, original in enumerate(first[group.reshape(-1)]):
        if position != original:
            x, y = bank.position_mm[position]
            message = f"position {position} lies at ({x:g}, {y:g}) mm like position {original}"
            yield BankProblem(position, None, message, "warning")


def _check_moved(bank: Bank) -> Iterator[BankProblem]:
    """One warning for all rows that were measured next to their position."""
    moved_mm = bank.quality["moved_mm"]
    moved = np.flatnonzero(moved_mm > 0)
    if len(moved):
        farthest = int(np.nanargmax(moved_mm))
        message = (
            f"{len(moved)} positions were measured next to their place, where there was light: position {farthest} by "
            f"{moved_mm[farthest]:.2g} mm; /quality/moved_mm has all of them"
        )
        yield BankProblem(farthest, None, message, "warning")


def _check_suspects(bank: Bank) -> Iterator[BankProblem]:
    """One finding for all rows measured when the sentinel had changed, and not again since; one for the other rows."""
    if (rows := _rows_in_place(bank)) is None:
        return
    figures = rows.figures
    suspects = np.flatnonzero(figures.suspect & (figures.status & Status.VALID == 0)).tolist()
    if suspects:
        message = (
            f"positions {row_ranges(suspects)} are suspect: the sentinel position had changed when it was measured"
            " after them (the vibrometer's range, a gain or the plate); put it right, then wavefocus remeasure"
        )
        yield BankProblem(suspects[0], None, message)
    others = np.flatnonzero((figures.status & (DOUBTFUL | Status.FAILED) != 0) & ~figures.suspect).tolist()
    if others:
        message = f"positions {row_ranges(others)} are over range, poor or failed, and are not judged: remeasure them"
        yield BankProblem(others[0], None, message, "warning")


def _check_rows(bank: Bank) -> Iterator[BankProblem]:
    status = _status_or_none(bank)
    rms = np.full((bank.positions, bank.actuators), np.nan)
    tail_db = np.full(bank.positions, -np.inf)
    spectra = RowsAtFrequencies(bank.positions, bank.actuators, bank.taps, bank.sample_rate_hz, bank.band_hz)
    for position in range(bank.positions):
        try:
            green = bank.green(position)
        except InputError as error:
            yield BankProblem(position, None, str(error).removeprefix(f"{bank.path}: "))
            continue
        if status is not None and not status[position] & Status.VALID:
            continue
        # energy of each actuator in each tenth of the taps, float64 so that nothing overflows
        energy = np.square(green, dtype=np.float64)
        rms[position] = np.sqrt(energy.mean(axis=1))
        tail_db[position] = _tail_db(energy.sum(axis=0))
        spectra.set(position, green)
    yield from _check_tails(tail_db)
    yield from _check_levels(rms, certain=status is not None)
    yield from _check_neighbours(bank, spectra, np.isfinite(rms).all(axis=1))


def _check_leak(bank: Bank) -> Iterator[BankProblem]:
    """An error for valid rows that were measured with a leak of 1 % of the median row, by ``/quality/leak_db``."""
    status, per_volt = _status_or_none(bank), response_per_volt(bank.rig_json)
    if status is None or bank.band_hz is None or per_volt is None:
        return
    limit = leak_limit(bank.rms[usable(status)], bank.taps, bank.sample_rate_hz, bank.band_hz, per_volt)
    if limit is None:
        return
    part = SOUND * 10.0 ** (bank.quality["leak_db"] / 20.0) / limit
    rows = np.flatnonzero((status == Status.VALID) & (part >= SPARE * SOUND))
    if len(rows):
        message = (
            f"crosstalk: the leak of the loopback was up to {100 * part[rows].max():.2g} % of the median row when "
            f"positions {row_ranges(rows.tolist())} were measured: {REMEDY}"
        )
        yield BankProblem(int(rows[0]), None, message)


def _status_or_none(bank: Bank) -> NDArray[np.uint8] | None:
    """Return the status, or None where it can only be guessed from rows that are not readable."""
    try:
        return bank.status
    except InputError:
        return None


def _tail_db(energy: Float64Array) -> float:
    """Energy of the last tenth of the taps against the strongest tenth, in dB."""
    if len(energy) < _TENTHS:
        return -np.inf
    tenths = np.array([part.mean() for part in np.array_split(energy, _TENTHS)])
    return float(10 * np.log10(tenths[-1] / tenths.max())) if tenths[-1] > 0 else -np.inf


def _check_tails(tail_db: Float64Array) -> Iterator[BankProblem]:
    """One warning for all positions: where one response is too long or too noisy, its neighbours are too."""
    limit_db = 20 * np.log10(SOUND)
    long = np.flatnonzero(tail_db > limit_db)
    if len(long):
        worst = int(np.argmax(tail_db))
        message = (
            f"the responses of {len(long)} of {len(tail_db)} positions are less than {-limit_db:z.0f} dB down in their"
            f" last tenth, position {worst} only {-tail_db[worst]:.0f} dB; they are noisy or longer than the taps kept"
        )
        yield BankProblem(worst, None, message, "warning")


def _check_levels(rms: Float64Array, *, certain: bool) -> Iterator[BankProblem]:
    """Check each position against the median of all, each actuator against the median of the others."""
    rows = np.sqrt(np.square(rms).mean(axis=1))
    measured = np.flatnonzero(np.isfinite(rows))
    if not len(measured):
        return
    typical = float(np.median(rows[measured]))
    for position in measured:
        if rows[position] == 0 and certain:
            yield BankProblem(int(position), None, f"position {position} is marked valid and holds only zeros")
        elif typical > 0 and not SILENT <= rows[position] / typical <= 1 / SILENT:
            level = 20 * np.log10(rows[position] / typical) if rows[position] else -np.inf
            message = f"the response of position {position} is {level:+.0f} dB from the median of all positions"
            yield BankProblem(int(position), None, message, "warning")
    levels = np.median(rms[measured], axis=0)
    for actuator, level in enumerate(levels):
        if level < SILENT * np.median(levels):
            message = f"actuator {actuator} gives less than a tenth of the others' response; is it connected?"
            yield BankProblem(None, actuator, message, "warning")


def _check_neighbours(bank: Bank, spectra: RowsAtFrequencies, measured: BoolArray) -> Iterator[BankProblem]:
    """Check each row against what its neighbours predict of it, or, on coarse grids, waves from all other rows."""
    on_grid = measured & ~rows_off_grid(bank.positions, bank.check_rows, bank.run_json)
    verdict = judge_rows(bank.position_mm, bank.actuator_mm, spectra, on_grid, measured)
    measured = measured if verdict.by_waves else on_grid
    for difference in verdict.differences:
        actuator = difference.actuators[0] if len(difference.actuators) == 1 else None
        yield BankProblem(difference.position, actuator, f"position {difference.position}: {difference.sentence}")
    there, judged = int(measured.sum()) * bank.actuators, int(verdict.judged.sum())
    if measured.sum() >= _NEIGHBOURHOOD and judged < there:
        message = (
            f"{there - judged} of {there} Green's functions were not judged by the other positions, which do not"
            " predict them: too few, too far apart, too noisy, near their actuator, or not in the order of the rows"
        )
        yield BankProblem(None, None, message, "note")


def _check_averages(bank: Bank) -> Iterator[BankProblem]:
    """What a single sweep cannot show."""
    try:
        capture = json.loads(bank.run_json or "")["capture"]
        single = capture["excitation"] != "staggered" and capture["averages"] == 1
    except (ValueError, TypeError, KeyError, RecursionError):
        return
    if single:
        yield BankProblem(None, None, ONE_AVERAGE, "note")


def check_file(path: str | Path) -> list[BankProblem]:
    """Check a bank, raw recordings, a drive or a field, whichever the file says that it is.

    path: A file of this program or of another; while it is written, what is just being written is not held against it.

    Returns list of Finding: nothing but notes when all is well. Raises InputError: the file cannot be opened as what it
    says that it is, or a checksum of the whole does not hold.
    """
    path = Path(path)
    found, sealed = format_of(path)
    if found == RAW.name:
        return list(_check_raw(path, sealed=sealed))
    if found == DRIVE:
        return [] if read_drive(path).verified else [_unverified("its values are unverified")]
    if found == FIELD:
        with FieldRowReader(path) as field:
            for _ in field.blocks():
                pass
            return [] if field.verified else [_unverified("its values are unverified")]
    return check_bank(path)


def _check_raw(path: Path, *, sealed: bool) -> Iterator[BankProblem]:
    with open_raw(path) as raw:
        if isinstance(raw.rows, RawRows):
            if not sealed:
                yield _unverified("what it says about itself is unverified")
            yield from _check_ledger(raw.rows, path)
        else:
            yield _unverified("its recordings are unverified")
        for position in range(raw.header.positions):
            try:
                raw.read(position)
            except InputError as error:
                yield BankProblem(position, None, str(error).removeprefix(f"{path}: "))


def _unverified(consequence: str) -> BankProblem:
    return BankProblem(None, None, f"the file carries no checksums of its contents: {consequence}", "warning")
