"""One factor on all rows of a position: found for all positions together, so that no wrong one hides another.

Each row's prediction from its neighbours leaves an error that is linear in the factors by which the rows would have to
be multiplied. Few positions are wrong, so the factors are those of least squares with an L1 penalty on their difference
from 1, by reweighted least squares (Daubechies, DeVore, Fornasier and Gunturk 2010), and then without the penalty.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from calibration.neighbours.prediction import Patch

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

PENALTY = 4.0
"""In standard deviations of a factor that is fitted alone."""
SUPPORT = 0.015
"""Factors nearer to 1 than this are 1."""
ROUNDS = 12
FLOOR = 0.3
"""A factor so many standard deviations from 1 is penalised like one at 1."""


@dataclass(frozen=True, slots=True)
class Gains:
    """Common factors of the rows of positions.

    value, float64 (positions,): The rows over what their neighbours say; 1 where nothing is known.
    sigmas, float64 (positions,): How many standard deviations of what other positions show it is from 1.
    explained, float64 (positions,): Which part of the unexpected error of the position's own rows the factors take
        away.
    """

    value: Float64Array
    sigmas: Float64Array
    explained: Float64Array


def common_gains(
    patches: Mapping[int, Patch],
    coefficients: Callable[[Patch], Complex128Array],
    values: Complex128Array,
    typical: Float64Array,
    judged: NDArray[np.bool_],
) -> Gains:
    """Find the positions whose rows all have one factor that is not 1.

    patches: The positions that can be predicted.
    coefficients: What each row of a patch counts in the error of its first, (frequencies, rows).
    values, complex128 (positions, actuators, frequencies): The rows.
    typical, float64 (positions, actuators, frequencies): Expected square of each row's error, > 0 where judged.
    judged, bool (positions, actuators): Rows whose errors count.
    """
    count = len(values)

    def parts_of(position: int) -> Complex128Array:
        """What each row of a patch adds to the errors of its first, in units of what is expected: (rows, errors)."""
        patch, actuators = patches[position], np.flatnonzero(judged[position])
        parts = values[patch.rows][:, actuators] * coefficients(patch).T[:, None, :]
        return np.asarray((parts / np.sqrt(typical[position, actuators])).reshape(len(patch.rows), -1))

    looked_at = {position: patch for position, patch in patches.items() if judged[position].any()}
    normal = _normal_matrix(looked_at, parts_of, count)
    stiffness = np.maximum(normal.diagonal(), np.finfo(np.float64).tiny)
    pull = -np.asarray(normal @ np.ones(count))
    deviation = 1.0 / np.sqrt(stiffness)
    known = np.flatnonzero(normal.diagonal() > 0)
    unknown = sparse.diags_array((normal.diagonal() <= 0).astype(np.float64))
    change, weight = np.zeros(count), PENALTY / deviation
    for _ in range(ROUNDS):
        change = splu((normal + sparse.diags_array(weight) + unknown).tocsc()).solve(pull)
        weight = PENALTY / deviation / (np.abs(change) + FLOOR * deviation)
    support = known[np.abs(change[known]) > SUPPORT]
    value, sigmas, explained = np.ones(count), np.zeros(count), np.zeros(count)
    if len(support):
        inner = normal.tocsr()[support][:, support].toarray()
        inverse = np.linalg.pinv(inner, hermitian=True)
        change = np.zeros(count)
        change[support] = inverse @ pull[support]
        others = np.setdiff1d(known, support)
        left = np.abs((pull - normal @ change)[others]) * deviation[others]
        usual = max(1.0, 1.4826 * float(np.median(left))) if len(others) else 1.0
        sigmas[support] = np.abs(change[support]) / np.sqrt(np.maximum(np.diag(inverse), 1e-300)) / usual
        correction = 1.0 + change[support]
        value[support] = 1.0 / np.where(np.abs(correction) > 1e-6, correction, 1e-6)
        for position in looked_at.keys() & set(support.tolist()):
            parts = parts_of(position)
            before = float(np.square(np.abs(parts.sum(axis=0))).sum())
            after = float(np.square(np.abs((1.0 + change[patches[position].rows]) @ parts)).sum())
            explained[position] = (before - after) / max(before - parts.shape[1], 1e-9 * before, 1e-300)
    return Gains(value, sigmas, explained)


def _normal_matrix(
    patches: Mapping[int, Patch], parts_of: Callable[[int], Complex128Array], count: int
) -> sparse.csc_array:
    """Normal equations of all errors, each in units of what is expected of it, in the factors on the rows."""
    row, column, entry = [], [], []
    for position, patch in patches.items():
        parts = parts_of(position)
        row.append(np.repeat(patch.rows, len(patch.rows)))
        column.append(np.tile(patch.rows, len(patch.rows)))
        entry.append((parts @ parts.conj().T).real.ravel())
    if not entry:
        return sparse.csc_array((count, count))
    indices = (np.concatenate(row), np.concatenate(column))
    return sparse.coo_array((np.concatenate(entry), indices), shape=(count, count)).tocsc()
