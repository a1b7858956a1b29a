"""Correction of a drive by scans of its control places: what the bank does not know of the plate is learnt from them.

Per frequency, with the drives' spectra F (N,), the bank's rows at the control places B (M, N), the wanted responses
w = B F of the uncorrected drive and the scanned ones z (M,):

    B <- B + W (z - B F) F* / |F|^2              Broyden's update: B F = z afterwards, where z is above its noise
    F <- F + B* (B B* + lambda I)^-1 (w - z)     the smallest step that removes the error

W = max(0, 1 - |e|^2 / |z - B F|^2), e the scan's noise. A step without the update converges as |1 - T / B|, T the
plate: not at all beneath a finger whose mass makes its place 20 dB harder to move; with it T = alpha B takes one round.
lambda is the least with which the energy of the drives stays within its cap. Source: Broyden, Mathematics of
Computation 19, 577 (1965).

A fifth of the control places is held out: the model never sees them, and a round counts only if they improve, too. What
fits the control places alone, as with a mirror that is off, does not.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft

from wavefocus.rendering.arrays import BoolArray, Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.drive.coil_limits import DriveLimits, limit_drive
from wavefocus.rendering.field.quiet_levels import positions_at
from wavefocus.rendering.number_text import percent
from wavefocus.rendering.verify.results import Correction, CorrectionRound, StopReason
from wavefocus.rendering.verify.scan import Scan
from wavefocus.storage.bank.ledger import Status
from wavefocus.storage.drive_file import Drive
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource

_NO_BETTER = 0.95
"""A round that leaves more than this of the error is the last."""
HELD_OUT, MIN_CONTROLS = 5, 10
"""Of so many control places one is held out, from so many on: two are the least that say anything."""
MAX_ENERGY = 5.0
"""Energy of corrected drives over that of the uncorrected one, by default."""
_MAX_MATRIX_BYTES = 2 << 30


def correct_drive(
    drive: Drive,
    bank: GreenSource,
    rows: Int64Array,
    measure: Callable[[Drive], Scan],
    rounds: int,
    *,
    limits: DriveLimits,
    max_energy: float = MAX_ENERGY,
    first: Scan | None = None,
) -> tuple[Drive, Correction]:
    """Correct a drive by scans of control places, at most so many times, and keep the best.

    rows: Bank rows of the control places, valid ones.
    measure: Plays a drive and scans the control places, or more.
    rounds: Corrections, each with a scan, >= 1.
    limits: What no actuator may exceed.
    max_energy: Largest energy of the drives over that of `drive`, > 1.
    first: A scan of `drive` that is there already.

    Returns the best drive, `drive` itself where no other is better, and what was found. Raises InputError: as
    `require_correctable`.
    """
    require_correctable(drive, bank, rows)
    few = rows.size < MIN_CONTROLS
    model = _Model(drive, bank, rows, held_out(rows))
    played, best, best_index, found = drive, drive, None, list[CorrectionRound]()
    scan = measure(drive) if first is None else first
    stopped: StopReason = "few" if few and rounds > 1 else "rounds"
    rounds = 1 if few else rounds
    for number in range(rounds + 1):
        state = model.learn(played, scan)
        if state is None:
            stopped = "dropouts"
            break
        found.append(state)
        goes_on = best_index is None or _is_better(state, found[best_index], _NO_BETTER)
        if best_index is None or _is_better(state, found[best_index], 1.0):
            best, best_index = played, number
        if not goes_on:
            fits = state.error <= _NO_BETTER * min(one.error for one in found[:-1])
            stopped = "held out" if fits and state.held_out is not None else "no better"
            break
        if state.error**2 <= 2.0 * state.noise**2:
            stopped = "noise"
            break
        if number == rounds:
            break
        corrected = model.next_drive(played, limits, max_energy)
        if corrected is None:
            stopped = "limit"
            break
        played = corrected
        scan = measure(played)
    return best, Correction(tuple(found), best_index, stopped)


def _is_better(state: CorrectionRound, than: CorrectionRound, share: float) -> bool:
    """Whether less is left than a share of the error, at the places held out, too."""
    held = state.held_out is None or than.held_out is None or state.held_out < share * than.held_out
    return state.error < share * than.error and held


def held_out(rows: Int64Array) -> Int64Array:
    """The control places that a correction does not see: every fifth, none of fewer than ten."""
    return rows[HELD_OUT // 2 :: HELD_OUT] if rows.size >= MIN_CONTROLS else rows[:0]


def require_correctable(drive: Drive, bank: GreenSource, rows: Int64Array) -> None:
    """Raise InputError where a drive cannot be corrected at these control places: no sound row, silence, too long."""
    if not rows.size:
        raise InputError("no control place of the scene is valid in the bank; measure them")
    if not np.any(drive.drive_v):
        raise InputError("the scene is silent, so there is nothing to correct; give a source an amplitude above 0")
    bins = _bins(drive, bank)[1].size
    needed = 16 * bins * rows.size * len(drive.drive_v)
    if needed > _MAX_MATRIX_BYTES:
        raise InputError(
            f"a correction at {rows.size} control places takes {needed / 2**30:.1f} GiB for a scene of this "
            f"length, more than {_MAX_MATRIX_BYTES / 2**30:g}; shorten the scene"
        )


def _bins(drive: Drive, bank: GreenSource) -> tuple[int, Int64Array]:
    """Length of the transforms, and the bins within the band in which the drive has power."""
    length = scipy.fft.next_fast_len(drive.drive_v.shape[1] + bank.taps - 1, real=True)
    frequency_hz = np.fft.rfftfreq(length, 1.0 / drive.sample_rate_hz)
    low_hz, high_hz = bank.band_hz or (0.0, drive.sample_rate_hz / 2)
    power = np.square(np.abs(scipy.fft.rfft(drive.drive_v, length))).sum(axis=0)
    power[(frequency_hz < low_hz) | (frequency_hz > high_hz)] = 0.0
    # Frequencies at which the drive has less, relative to its loudest, are left alone: the scan says nothing there.
    return length, np.flatnonzero(power > 1e-4 * power.max())


_STOPPED_WORDS = {
    "rounds": "all corrections that were asked for are made",
    "noise": "what is left is the scan's noise",
    "no better": "the last correction made it no better",
    "held out": "the last correction made it no better at the control places held out",
    "few": f"with fewer than {MIN_CONTROLS} control places none is held out, so one correction is made and no more",
    "mirror": "the sentinel position shows the field of another place: calibrate the mirror, then correct the drive",
    "limit": "limits or energy leave no room for a correction: lower the amplitude of the scene",
    "dropouts": "fewer than half of the control places had a usable record",
}


def correction_lines(correction: Correction) -> list[str]:
    """A line for each scan, and one for the end."""
    lines = [
        f"{'uncorrected' if not number else f'correction {number}'}: error {percent(state.error)} at "
        f"{state.positions} control places (noise {percent(state.noise)})"
        f"{'' if state.held_out is None else f', {percent(state.held_out)} at those held out'}, "
        f"energy {state.energy:.3g} times, peak {state.peak_v:.3g} V"
        for number, state in enumerate(correction.rounds)
    ]
    kept = "the uncorrected drive is kept" if not correction.best else f"correction {correction.best} is kept"
    return [*lines, f"{_STOPPED_WORDS[correction.stopped]}; {kept}"]


def control_rows(drive: Drive, position_mm: Float64Array) -> Int64Array:
    """Bank rows at which a correction is judged: those of the scene's foci and quiet places."""
    quiet = [row for track in drive.quiet for row in positions_at(track, position_mm)[0]]
    return np.unique(np.concatenate([drive.focus_position, *quiet]))


class _Model:
    """What is known of the plate at the control places, per frequency."""

    def __init__(self, drive: Drive, bank: GreenSource, rows: Int64Array, held_out: Int64Array) -> None:
        self._rows, self._held_rows, self._drive = np.setdiff1d(rows, held_out), held_out, drive
        self._length, self._bins = _bins(drive, bank)
        self._green = self._transforms(bank, self._rows)
        drives = self._spectra(drive.drive_v).T
        self._wanted = self._respond(drives)
        self._held_wanted = (self._transforms(bank, held_out) @ drives[:, :, None])[:, :, 0]
        self._error = np.zeros_like(self._wanted)
        self._energy = float(np.square(drive.drive_v).sum())

    def _transforms(self, bank: GreenSource, rows: Int64Array) -> Complex128Array:
        green = np.empty((self._bins.size, rows.size, len(self._drive.drive_v)), np.complex128)
        for index, row in enumerate(rows.tolist()):
            green[:, index] = self._spectra(np.asarray(bank.green(row), np.float64)).T
        return green

    def learn(self, played: Drive, scan: Scan) -> CorrectionRound | None:
        """Update what is known by a scan of a drive; None where too few places have a usable record."""
        at = np.searchsorted(scan.position_index, self._rows)
        usable: BoolArray = scan.status[at] == Status.VALID
        if 2 * np.count_nonzero(usable) < usable.size:
            return None
        drives = self._spectra(played.drive_v).T
        expected = self._respond(drives)
        scanned = np.where(usable, self._spectra(scan.field[at].astype(np.float64)).T, expected)
        noise = np.where(usable, np.nan_to_num(scan.noise_rms[at]) ** 2 * scan.field.shape[1], 0.0)
        missed = scanned - expected
        power = np.square(np.abs(drives)).sum(axis=1, keepdims=True)
        weight = np.maximum(0.0, 1.0 - noise / np.maximum(np.square(np.abs(missed)), 1e-300))
        self._green += (weight * missed)[:, :, None] * (drives.conj() / power)[:, None, :]
        self._error = np.where(usable, self._wanted - scanned, 0.0)
        wanted = float(np.square(np.abs(self._wanted[:, usable])).sum())
        return CorrectionRound(
            error=float(np.sqrt(np.square(np.abs(self._error)).sum() / wanted)),
            noise=float(np.sqrt(noise.sum() * self._bins.size / wanted)),
            energy=float(np.square(played.drive_v).sum()) / self._energy,
            peak_v=float(np.abs(played.drive_v).max()),
            positions=int(np.count_nonzero(usable)),
            held_out=self._held_out_error(scan),
        )

    def _held_out_error(self, scan: Scan) -> float | None:
        """As `CorrectionRound.error`, at the places that are held out; None where none has a usable record."""
        at = np.searchsorted(scan.position_index, self._held_rows)
        usable = scan.status[at] == Status.VALID
        if not usable.any():
            return None
        wanted = self._held_wanted[:, usable]
        missed = self._spectra(scan.field[at[usable]].astype(np.float64)).T - wanted
        return float(np.linalg.norm(missed) / np.linalg.norm(wanted))

    def next_drive(self, played: Drive, limits: DriveLimits, max_energy: float) -> Drive | None:
        """The corrected drive of the least error within energy and limits; None where they leave no room."""
        green, adjoint = self._green, self._green.conj().transpose(0, 2, 1)
        many = green.shape[1] > green.shape[2]  # then (B* B + lambda I)^-1 B* is the same and smaller
        gram = adjoint @ green if many else green @ adjoint
        right = (adjoint @ self._error[:, :, None]) if many else self._error[:, :, None]
        scale = float(np.square(np.abs(green)).sum()) / (green.shape[0] * green.shape[1])
        eye = np.eye(gram.shape[1])
        step_v = np.zeros_like(played.drive_v)
        # lambda over the mean power of a row, from the most to the least thorough step.
        for ridge in 10.0 ** np.arange(-3.0, 2.25, 0.25):
            solved = np.linalg.solve(gram + ridge * scale * eye, right)
            whole = np.zeros((len(step_v), self._length // 2 + 1), np.complex128)
            whole[:, self._bins] = (solved if many else adjoint @ solved)[:, :, 0].T
            step_v = scipy.fft.irfft(whole, self._length)[:, : step_v.shape[1]]
            if np.square(played.drive_v + step_v).sum() <= max_energy * self._energy:
                break

        def is_too_large(parts: int) -> bool:
            candidate = played.drive_v + parts / 256 * step_v
            if np.square(candidate).sum() > max_energy * self._energy:
                return True
            return limit_drive(candidate, played.sample_rate_hz, limits).scale != 1.0

        # How much of the step limits and energy allow.
        share = bisect_left(range(1, 257), True, key=is_too_large) / 256
        return None if share < 0.01 else replace(played, drive_v=played.drive_v + share * step_v)

    def _spectra(self, signals: Float64Array) -> Complex128Array:
        return np.asarray(scipy.fft.rfft(signals, self._length)[:, self._bins])

    def _respond(self, drives: Complex128Array) -> Complex128Array:
        return np.asarray((self._green @ drives[:, :, None])[:, :, 0])
