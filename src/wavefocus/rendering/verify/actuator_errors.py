"""Levels and delays of all actuators together, by least squares over the blocks of a verification."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavefocus.rendering.arrays import BoolArray, Float64Array
from wavefocus.rendering.verify.superposition import Blocks, energy

ITERATIONS = 6
MAX_STEP_S = 5e-4
"""Larger steps of a delay would leave the range in which its effect is linear."""
ALIKE_DB, ALIKE_S = 0.6, 4e-5
"""Changes that differ by less are one change."""
MIN_DB, MIN_S = 0.25, 2e-5
MIN_LEVEL = 0.1
"""Below a factor of -20 dB an actuator is silent: it has no delay."""
WORSE = 1.05
"""A plainer description may leave this much more."""


@dataclass(frozen=True, slots=True)
class ActuatorErrors:
    """Factor and delay of each actuator (A,); 1 and 0 where it is as in the bank."""

    factor: Float64Array
    late_s: Float64Array

    @property
    def changes(self) -> Float64Array:
        """Factor and delay of those that are not as in the bank, (changed, 2)."""
        return np.stack([self.factor, self.late_s], axis=1)[self.changed]

    @property
    def changed(self) -> BoolArray:
        """Actuators that are not as in the bank."""
        return np.asarray((self.factor != 1.0) | (self.late_s != 0.0))


def solved(blocks: Blocks) -> tuple[Float64Array, Float64Array]:
    """Small relative changes of all levels, and of all delays in s, that fit best together."""
    actuators = blocks[0].green.shape[1]
    matrix, right = np.zeros((2 * actuators, 2 * actuators)), np.zeros(2 * actuators)
    for block in blocks:
        parts = block.parts
        columns = np.concatenate([parts, -2j * np.pi * block.frequency_hz * parts], axis=1)
        matrix += np.einsum("rak,rbk->ab", columns.conj(), columns, optimize=True).real
        right += np.einsum("rak,rk->a", columns.conj(), block.difference).real
    scale = np.sqrt(np.where(np.diag(matrix) > 0.0, np.diag(matrix), 1.0))
    changes = np.linalg.lstsq(matrix / np.outer(scale, scale), right / scale, rcond=1e-6)[0] / scale
    level, late_s = np.split(changes, 2)
    return level, late_s


def levels(blocks: Blocks, members: BoolArray) -> Float64Array:
    """Factors of some actuators that fit best together; 1 of the others."""
    factor = np.ones(len(members))
    matrix, right = 0.0, 0.0
    for block in blocks:
        parts = block.parts[:, members]
        matrix = matrix + np.einsum("rak,rbk->ab", parts.conj(), parts, optimize=True).real
        right = right + np.einsum("rak,rk->a", parts.conj(), block.difference).real
    factor[members] += np.linalg.lstsq(np.asarray(matrix), np.asarray(right), rcond=1e-8)[0]
    return factor


def joint_errors(blocks: Blocks) -> ActuatorErrors | None:
    """Levels and delays of all actuators, rounded to the fewest different changes that fit as well.

    Returns None where nothing is found that leaves less.
    """
    actuators = blocks[0].green.shape[1]
    fits = [_levels_only(blocks), _with_delays(blocks)]
    left = [_left(blocks, fit) for fit in fits]
    best = fits[0] if left[0] <= WORSE * left[1] else fits[1]
    plain = _plainest(blocks, best)
    return plain if actuators > 1 and plain.changed.any() else None


def _levels_only(blocks: Blocks) -> ActuatorErrors:
    everyone = np.ones(blocks[0].green.shape[1], bool)
    return ActuatorErrors(levels(blocks, everyone), np.zeros(len(everyone)))


def _with_delays(blocks: Blocks) -> ActuatorErrors:
    """Gauss-Newton from what each actuator shows by itself."""
    actuators = blocks[0].green.shape[1]
    errors = ActuatorErrors(np.ones(actuators), np.zeros(actuators))
    left = _left(blocks, errors)
    for _ in range(ITERATIONS):
        level, late_s = solved(_driven(blocks, errors))
        step = min(1.0, MAX_STEP_S / max(float(np.abs(late_s).max()), 1e-12))
        for _half in range(4):
            tried = ActuatorErrors(errors.factor * (1.0 + step * level), errors.late_s + step * late_s)
            if (now := _left(blocks, tried)) < left:
                break
            step *= 0.5
        else:
            break
        gained, left, errors = left - now, now, tried
        if gained < 1e-3 * left:
            break
    return errors


def _plainest(blocks: Blocks, errors: ActuatorErrors) -> ActuatorErrors:
    """Changes that are alike made equal, small ones left out, while that leaves hardly more."""
    allowed = WORSE * _left(blocks, errors) + len(blocks[0].response)
    db = 20.0 * np.log10(np.maximum(np.abs(errors.factor), 1e-10))
    silent = np.abs(errors.factor) < MIN_LEVEL
    factor = np.where(silent, 0.0, _clustered(errors.factor, db, ALIKE_DB, MIN_DB, errors.factor > 0.0))
    late_s = np.where(silent, 0.0, _clustered(errors.late_s, errors.late_s, ALIKE_S, MIN_S, np.ones(len(db), bool)))
    # A reversed cable that is as loud as before.
    factor = np.where((errors.factor < 0.0) & ~silent & (np.abs(db) < ALIKE_DB), -1.0, factor)
    plain = ActuatorErrors(factor, late_s)
    return plain if _left(blocks, plain) <= allowed else errors


def _clustered(
    values: Float64Array, measure: Float64Array, alike: float, least: float, positive: BoolArray
) -> Float64Array:
    """Values whose measures lie together replaced by their mean; those of small measure by no change."""
    result = values.copy()
    order = np.argsort(measure)
    clusters = np.split(order, 1 + np.flatnonzero(np.diff(measure[order]) > alike))
    for cluster in clusters:
        for sign in (True, False):
            members = cluster[positive[cluster] == sign]
            if members.size:
                result[members] = np.mean(values[members])
    small = (np.abs(measure) < least) & positive
    nothing = 1.0 if values is not measure else 0.0
    result[small] = nothing
    return result


def _driven(blocks: Blocks, errors: ActuatorErrors) -> Blocks:
    return tuple(
        block.driven(errors.factor[:, None] * np.exp(-2j * np.pi * np.outer(errors.late_s, block.frequency_hz)))
        for block in blocks
    )


def _left(blocks: Blocks, errors: ActuatorErrors) -> float:
    return sum(energy(block.difference) for block in _driven(blocks, errors))
