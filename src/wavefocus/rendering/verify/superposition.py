"""Responses as sums over actuators, ``sum_i green_i drive_i`` at some frequencies; each actuator's factor and delay.

Differences count in units of what is allowed. Factors and delays follow by least squares.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration.evidence import SILENT, SOUND, TOLERANCE
from wavefocus.calibration.numerics import evenly_spread, transform_at
from wavefocus.rendering.arrays import Complex128Array, Float32Array, Float64Array, Int64Array
from wavefocus.rendering.verify.results import Sentinel

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Responses (R, K) and what they are made of, each in units of what is allowed of it: ``sum_i green_i drive_i``.

    rows, float32 (r, A, L): Green's functions; `row_of` (R,) says which of them belongs to a response.
    weight, float64 (R,): One over what is allowed of each response.
    green, complex128 (R, A, K): Transforms of the rows, weighted.
    drive, complex128 (R or 1, A, K): Drives.
    noise: Sum of squares that the noise makes, in units of what is allowed.
    """

    frequency_hz: Float64Array
    rate_hz: float
    rows: Float32Array
    row_of: Int64Array
    weight: Float64Array
    green: Complex128Array
    drive: Complex128Array
    response: Complex128Array
    noise: float

    def faster(self, change: float) -> Block:
        """The same where waves are faster by this share: the Green's functions of ``frequency / (1 + change)``."""
        return self.with_green(transforms(self.rows, self.frequency_hz / (1.0 + change), self.rate_hz))

    def with_green(self, green: Complex128Array) -> Block:
        """The same with other Green's functions (r, A, K)."""
        return replace(self, green=green[self.row_of] * self.weight[:, None, None])

    def driven(self, factor: Float64Array, late_s: Float64Array) -> Block:
        """The same with drives changed by a factor (A,), and later by a time (A,)."""
        return replace(
            self, drive=self.drive * (factor[:, None] * np.exp(-2j * np.pi * np.outer(late_s, self.frequency_hz)))
        )

    def exchanged(self, one: int, other: int) -> Block:
        """The same with the drives of two actuators exchanged."""
        order = np.arange(self.drive.shape[1])
        order[[one, other]] = other, one
        return replace(self, drive=self.drive[:, order])

    def some(self, most: int, frequencies: int) -> Block:
        """The same with some of the responses, or all where they share their rows, at some of the frequencies."""
        at, some = evenly_spread(len(self.frequency_hz), frequencies), self
        if len(self.rows) > most:
            chosen = evenly_spread(len(self.rows), most)
            some = replace(self.of(chosen), rows=self.rows[chosen], row_of=np.arange(len(chosen)))
        return replace(
            some, frequency_hz=some.frequency_hz[at], green=some.green[..., at], drive=some.drive[..., at],
            response=some.response[:, at],
        )  # fmt: skip

    def of(self, chosen: Int64Array) -> Block:
        """The same with some of the responses."""
        drive = self.drive if len(self.drive) == 1 else self.drive[chosen]
        return replace(
            self, row_of=self.row_of[chosen], weight=self.weight[chosen], green=self.green[chosen], drive=drive,
            response=self.response[chosen],
        )  # fmt: skip

    @property
    def parts(self) -> Complex128Array:
        """What each actuator contributes, (R, A, K)."""
        return np.asarray(self.green * self.drive)

    @property
    def difference(self) -> Complex128Array:
        """Response minus prediction, (R, K)."""
        return np.asarray(self.response - np.einsum("rak,rak->rk", self.green, self.drive))


Blocks = tuple[Block, ...]


def squares_left(blocks: Blocks) -> float:
    """Sum of squares of the differences, in units of what is allowed."""
    return sum(energy(block.difference) for block in blocks)


def transforms(rows: NDArray[Any], frequency_hz: Float64Array, rate_hz: float) -> Complex128Array:
    """Fourier transforms (..., K) of rows (..., taps) as of `transform_at`, made in single precision."""
    return transform_at(np.asarray(rows, np.float32), frequency_hz, rate_hz).astype(np.complex128)


def block_of(
    rows: Float32Array,
    row_of: Int64Array,
    frequency_hz: Float64Array,
    rate_hz: float,
    drive: Complex128Array,
    response: Complex128Array,
    noise: Float64Array,
) -> Block:
    """Put together responses (R, K), drives (R or 1, A, K) and Green's functions, each response in its own unit.

    rows, row_of, frequency_hz, rate_hz: As of `Block`.
    noise, float64 (R,): Energy of the noise in each response, at these frequencies; NaN where unknown.
    """
    green = transforms(rows, frequency_hz, rate_hz)[row_of]
    predicted = np.einsum("rak,rak->rk", green, np.broadcast_to(drive, (len(row_of), *drive.shape[1:])))
    level = 0.5 * (energies(predicted) + energies(response))
    allowed = np.nan_to_num(noise) + SOUND**2 * level
    weight = 1.0 / np.sqrt(np.where(allowed > 0.0, allowed, np.inf))
    return Block(
        frequency_hz, rate_hz, rows, row_of, weight, green * weight[:, None, None], drive, response * weight[:, None],
        float(np.nan_to_num(noise) @ weight**2),
    )  # fmt: skip


def sentinel_block(sentinel: Sentinel, bank: GreenSource) -> Block:
    """One response for each actuator, which alone is driven, with 1 V at all frequencies."""
    rate_hz, rows = bank.sample_rate_hz, np.asarray(bank.green(sentinel.position), np.float32)[None]
    low_hz, high_hz = bank.band_hz or (0.0, 0.45 * rate_hz)
    frequency_hz = np.linspace(max(low_hz, rate_hz / bank.taps), min(high_hz, 0.48 * rate_hz), 64)
    alone = np.repeat(np.eye(bank.actuators)[:, :, None], len(frequency_hz), axis=2).astype(np.complex128)
    response = transforms(sentinel.green, frequency_hz, rate_hz)
    noise = 2.0 * energies(response) * 10.0 ** (-np.asarray(sentinel.snr_db, np.float64) / 10.0)  # of both measurements
    return block_of(rows, np.zeros(bank.actuators, np.int64), frequency_hz, rate_hz, alone, response, noise)


def energies(values: NDArray[Any]) -> Float64Array:
    """Sum of squares of each row."""
    return np.asarray(np.square(np.abs(values)).sum(axis=1), np.float64)


def energy(values: NDArray[Any]) -> float:
    """Sum of squares of all values."""
    return float(np.square(np.abs(values)).sum())


TIE = 0.02
"""What explains as much within this share is not told apart: a cause is not named then, and of the delays of a tone,
which repeats in each period, the smallest is taken."""
_WORTH_A_STEP = 0.01
"""Share of what is left that a step of the search must take off."""
MIN_DB, MIN_DELAY_S = 20 * np.log10(1 + TOLERANCE), TOLERANCE / (2 * np.pi * 250)
"""Changes that are named, and apart from which two are one: 0.42 dB, and 0.03 ms at 250 Hz, make an error that a
verification allows."""


@dataclass(frozen=True, slots=True)
class ActuatorErrors:
    """Factor and delay of each actuator (A,); 1 and 0 where it is as in the bank."""

    factor: Float64Array
    late_s: Float64Array

    @property
    def level_db(self) -> Float64Array:
        """Levels of the factors, (A,)."""
        return np.asarray(20.0 * np.log10(np.maximum(np.abs(self.factor), 1e-10)))

    def applied(self, blocks: Blocks) -> Blocks:
        """The blocks with drives changed so."""
        return tuple(block.driven(self.factor, self.late_s) for block in blocks)


def fitted_errors(blocks: Blocks) -> ActuatorErrors:
    """Factors and delays that leave least, each actuator with its own."""
    actuators = blocks[0].green.shape[1]
    errors = ActuatorErrors(np.ones(actuators), np.zeros(actuators))
    # Step of the search, in periods of the highest frequency: a hundredth of a turn, from where the fit converges.
    finest_s = 0.01 / max(float(block.frequency_hz.max()) for block in blocks)
    # Delays are looked for within this time, either way.
    ahead_s = np.arange(0.0, 0.02, finest_s)
    delays_s = np.concatenate([-ahead_s[:0:-1], ahead_s])
    # These exponentials take longer than all else of a step, and are the same in each.
    turns = [np.exp(2j * np.pi * np.outer(delays_s, block.frequency_hz)) for block in blocks]
    for _ in range(actuators + 1):  # each actuator, and all together
        step = _best_step(errors.applied(blocks), delays_s, turns)
        if step is None:
            break
        errors = ActuatorErrors(errors.factor * step.factor, errors.late_s + step.late_s)
    return _refined(blocks, errors, np.eye(actuators))


def grouped_errors(blocks: Blocks, errors: ActuatorErrors, allowed: float) -> ActuatorErrors:
    """The same with few different changes: equal where they are alike, none where that leaves at most `allowed` more.

    The groups' factors and delays are those that leave least.
    """
    groups = list(_groups(blocks, errors, allowed))
    members = np.zeros((len(errors.factor), len(groups)))
    factor, late_s = np.ones(len(members)), np.zeros(len(members))
    for column, group in enumerate(groups):
        members[group, column] = 1.0
        factor[group], late_s[group] = errors.factor[group].mean(), errors.late_s[group].mean()
    silent = np.abs(factor) < SILENT
    start = ActuatorErrors(np.where(silent, 0.0, factor), np.where(silent, 0.0, late_s))
    return _refined(blocks, start, members) if groups else start


def _groups(blocks: Blocks, errors: ActuatorErrors, allowed: float) -> Iterator[list[int]]:
    """Actuators whose changes are alike; those that hardly change are in none."""
    factor, late_s, level_db = errors.factor, errors.late_s, errors.level_db
    cost = np.zeros(len(factor))
    for block in blocks:
        turned = factor[:, None] * np.exp(-2j * np.pi * np.outer(late_s, block.frequency_hz)) - 1.0
        cost += np.einsum("rak,ak->a", np.square(np.abs(block.parts)), np.square(np.abs(turned)))
    small = (factor > 0.0) & (np.abs(level_db) < MIN_DB) & (np.abs(late_s) < MIN_DELAY_S)
    order = np.argsort(cost)
    unchanged = set(order[np.cumsum(cost[order]) <= allowed].tolist()) | set(np.flatnonzero(small).tolist())
    left = [index for index in range(len(factor)) if index not in unchanged]
    while left:
        first = left[0]
        both_silent = (np.abs(factor[left]) < SILENT) & (abs(factor[first]) < SILENT)
        same = (np.sign(factor[left]) == np.sign(factor[first])) & (
            np.abs(level_db[left] - level_db[first]) < MIN_DB
        ) & (np.abs(late_s[left] - late_s[first]) < MIN_DELAY_S)  # fmt: skip
        group = [index for index, alike in zip(left, same | both_silent, strict=True) if alike]
        yield group
        left = [index for index in left if index not in group]


def _best_step(blocks: Blocks, delays_s: Float64Array, turns: Sequence[Complex128Array]) -> ActuatorErrors | None:
    """The change of one actuator, or of all alike, that takes off most; None where none takes off enough.

    turns: Of each block, ``exp(2 pi j delay frequency)`` of the delays that are tried (delays, K).
    """
    own = matched = agreement = np.zeros(0)
    for index, block in enumerate(blocks):
        parts, difference = block.parts, block.difference
        parts = np.concatenate([parts, parts.sum(axis=1, keepdims=True)], axis=1)
        cross = np.einsum("rak,rak->ak", parts.conj(), difference[:, None] + parts)
        these = (
            np.einsum("rak,rak->a", parts.conj(), parts).real,
            np.einsum("rak,rk->a", parts.conj(), difference).real,
            (turns[index] @ cross.T).real,
        )
        own, matched, agreement = these if not index else (own + these[0], matched + these[1], agreement + these[2])
    safe = np.where(own > 0.0, own, np.inf)
    gained = np.square(agreement) / safe - 2.0 * matched - own
    best = int(np.argmax(gained.max(axis=0)))
    column = gained[:, best]
    if column.max() <= _WORTH_A_STEP * squares_left(blocks):
        return None
    good = np.flatnonzero(column >= (1.0 - TIE) * column.max())
    at = int(good[np.argmin(np.abs(delays_s[good]))])
    actuators = len(own) - 1
    changed = np.arange(actuators) == best if best < actuators else np.ones(actuators, bool)
    factor, late_s = float(agreement[at, best] / safe[best]), float(delays_s[at])
    return ActuatorErrors(np.where(changed, factor, 1.0), np.where(changed, late_s, 0.0))


def _refined(blocks: Blocks, errors: ActuatorErrors, members: Float64Array) -> ActuatorErrors:
    """Gauss-Newton steps, halved where they do not help; the actuators of a column of `members` change alike."""
    left = squares_left(errors.applied(blocks))
    for _ in range(10):
        level, late_s = (members @ change for change in _linear_changes(errors.applied(blocks), members))
        # Larger steps of a delay leave the range in which its effect is linear: a quarter of a period at 500 Hz.
        step = min(1.0, 5e-4 / max(float(np.abs(late_s).max()), 1e-12))
        for _half in range(4):
            tried = ActuatorErrors(errors.factor * (1.0 + step * level), errors.late_s + step * late_s)
            if (now := squares_left(tried.applied(blocks))) < left:
                break
            step *= 0.5
        else:
            break
        gained, left, errors = left - now, now, tried
        if gained < 1e-3 * left:
            break
    return errors


def _linear_changes(blocks: Blocks, members: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Small relative changes of the levels, and of the delays in s, that fit best, of each column of `members`."""
    groups = members.shape[1]
    matrix, right = np.zeros((2 * groups, 2 * groups)), np.zeros(2 * groups)
    for block in blocks:
        parts = np.einsum("rak,ag->rgk", block.parts, members)
        columns = np.concatenate([parts, -2j * np.pi * block.frequency_hz * parts], axis=1)
        columns = np.moveaxis(columns, 1, 0).reshape(2 * groups, -1)
        matrix += (columns.conj() @ columns.T).real
        right += (columns.conj() @ block.difference.ravel()).real
    scale = np.sqrt(np.where(np.diag(matrix) > 0.0, np.diag(matrix), 1.0))
    changes = np.linalg.lstsq(matrix / np.outer(scale, scale), right / scale, rcond=1e-6)[0] / scale
    level, late_s = np.split(changes, 2)
    return level, late_s
