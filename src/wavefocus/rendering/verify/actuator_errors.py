"""Factor and delay of each actuator against the bank, by least squares over the responses of a verification."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from wavefocus.calibration.evidence import SILENT, TOLERANCE
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.verify.superposition import Blocks, squares_left

TIE = 0.02
"""What explains as much within this share is not told apart: a cause is not named then, and of the delays of a tone,
which repeats in each period, the smallest is taken."""
WORTH_A_STEP = 0.01
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
    for _ in range(actuators + 1):  # each actuator, and all together
        step = _best_step(errors.applied(blocks))
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


def _best_step(blocks: Blocks) -> ActuatorErrors | None:
    """The change of one actuator, or of all alike, that takes off most; None where none takes off enough."""
    # Step of the search, in periods of the highest frequency: a hundredth of a turn, from where the fit converges.
    finest_s = 0.01 / max(float(block.frequency_hz.max()) for block in blocks)
    # Delays are looked for within this time, either way.
    ahead_s = np.arange(0.0, 0.02, finest_s)
    delays_s = np.concatenate([-ahead_s[:0:-1], ahead_s])
    own = matched = agreement = np.zeros(0)
    for index, block in enumerate(blocks):
        parts, difference = block.parts, block.difference
        parts = np.concatenate([parts, parts.sum(axis=1, keepdims=True)], axis=1)
        cross = np.einsum("rak,rak->ak", parts.conj(), difference[:, None] + parts)
        these = (
            np.einsum("rak,rak->a", parts.conj(), parts).real,
            np.einsum("rak,rk->a", parts.conj(), difference).real,
            (np.exp(2j * np.pi * np.outer(delays_s, block.frequency_hz)) @ cross.T).real,
        )
        own, matched, agreement = these if not index else (own + these[0], matched + these[1], agreement + these[2])
    safe = np.where(own > 0.0, own, np.inf)
    gained = np.square(agreement) / safe - 2.0 * matched - own
    best = int(np.argmax(gained.max(axis=0)))
    column = gained[:, best]
    if column.max() <= WORTH_A_STEP * squares_left(blocks):
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
