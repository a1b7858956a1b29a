"""Rows of a bank predicted from their neighbours, each row left out in turn, up to one factor per position.

Each row's prediction from its neighbours leaves an error that is linear in the factors by which the rows would have to
be multiplied. Few positions are wrong, so the factors are those of least squares with an L1 penalty on their difference
from 1, by reweighted least squares (Daubechies, DeVore, Fornasier and Gunturk 2010), and then without the penalty.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree

from wavefocus.calibration import BoolArray, Complex128Array, Float64Array, Int64Array
from wavefocus.calibration.blas import one_blas_thread
from wavefocus.calibration.numerics import evenly_spread, on_a_line
from wavefocus.calibration.wave_model import Patch, PatchKernel, WaveModel, fit_waves

PENALTY = 4.0
"""In standard deviations of a factor that is fitted by itself."""
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
    judged: BoolArray,
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


REACH_SPACINGS = 2.6
"""Neighbours are this near, in grid spacings: 20 on a square grid, 18 on a hexagonal one."""
FURTHEST_SPACINGS = 4.5
"""At the rim, where fewer are so near, they may be this far."""
MIN_NEIGHBOURS, WANTED_NEIGHBOURS, MAX_NEIGHBOURS = 8, 14, 24
SAME_SPACINGS = 1e-3
FIT_PATCHES, FIT_SHAPES, FIT_FREQUENCIES = 12, 2, 11
TIES = 12
"""Positions of a lattice that may be equally far; of those at the edge the first rows are taken."""


class RowsPredicted:
    """Leave-one-out predictions of all rows of a bank.

    A row is predicted by kernel regression over the bank's own waves (`wavefocus.calibration.wave_model`) from the
    rows of its neighbours, actuator by actuator and frequency by frequency.

    position_mm, float64 (positions, 2): Grid in millimetres.
    values, complex128 (positions, actuators, frequencies): Fourier transforms of the rows.
    frequency_hz, float64 (frequencies,): Ascending, > 0.
    usable, bool (positions,): Rows that are there; the others are holes.

    spacing_mm: Median distance of neighbouring positions; 0 where there are fewer than two.
    patches: The positions that can be predicted at all.
    """

    def __init__(
        self, position_mm: Float64Array, values: Complex128Array, frequency_hz: Float64Array, usable: BoolArray
    ) -> None:
        self.values = values
        self.frequency_hz = frequency_hz
        self._position_mm = position_mm
        self.patches, self.spacing_mm = _patches(position_mm, usable)
        self._kernels: dict[bytes, PatchKernel] = {}
        if self.patches:
            with one_blas_thread():
                self.waves = self._fit()

    @property
    def neighbours(self) -> dict[int, Int64Array]:
        """Of each position that can be predicted, itself and the rows that it is predicted from."""
        return {position: patch.rows for position, patch in self.patches.items()}

    def errors(self) -> tuple[Complex128Array, Float64Array]:
        """Error of every row, left out, and the kernel's expectation of its square for a field of strength 1.

        Returns errors : complex128 (positions, actuators, frequencies): what the row has more than its prediction; NaN
        where there is none; variance : float64 of that shape, the same for all actuators.
        """
        errors = np.full(self.values.shape, np.nan + 0j)
        variance = np.full((len(self.values), len(self.frequency_hz)), np.nan)
        by_shape: dict[bytes, list[int]] = {}
        for position, patch in self.patches.items():
            by_shape.setdefault(patch.key, []).append(position)
        with one_blas_thread():
            for positions in by_shape.values():
                patch = self.patches[positions[0]]
                weights = self.coefficients(patch)
                rows = np.stack([self.patches[position].rows for position in positions])
                missed = np.zeros((len(positions), *self.values.shape[1:]), dtype=np.complex128)
                for place in range(rows.shape[1]):
                    missed += self.values[rows[:, place]] * weights[:, place]
                errors[positions] = missed
                variance[positions] = self._kernel(patch).left_out_variance
        return errors, np.repeat(variance[:, None], self.values.shape[1], axis=1)

    def error_without(
        self, position: int, others: Int64Array, actuators: Int64Array
    ) -> tuple[Complex128Array, Float64Array]:
        """Error of some of a position's rows with some neighbours left out as well, and its expected square.

        With T the position and those others, C the covariance and M = (C^-1)_TT^-1: the first entry of
        M (C^-1 g)_T, and M's first.

        Returns errors : complex128 (actuators, frequencies); variance : float64 (frequencies,).
        """
        patch = self.patches[position]
        among = (patch.rows[:, None] == others).any(axis=1)
        among[0] = True
        out = among.nonzero()[0]
        inverse = self._kernel(patch).inverse
        known = inverse[:, out] @ self.values[patch.rows[:, None], actuators].transpose(2, 0, 1)
        left = np.linalg.inv(inverse[:, out[:, None], out])[:, :1]
        return np.asarray((left @ known)[:, 0].T), np.asarray(left[:, 0, 0].real)

    def at(self, position: int, offset_mm: Float64Array, values: Complex128Array) -> Complex128Array:
        """Rows at places near a position, from its neighbours only, (places, actuators, frequencies).

        values, complex128 (positions, actuators, frequencies): The rows to use, wrong ones replaced.
        """
        patch = self.patches[position]
        kernel = PatchKernel(self.waves, patch.offset_mm[1:])
        weights = kernel.weights(offset_mm)
        return np.asarray(np.einsum("fpn,naf->paf", weights, values[patch.rows[1:]]))

    def coefficients(self, patch: Patch) -> Complex128Array:
        """What each row of a patch counts in the error of its first, (frequencies, rows): 1 for the first."""
        return self._kernel(patch).left_out

    def _kernel(self, patch: Patch) -> PatchKernel:
        if patch.key not in self._kernels:
            self._kernels[patch.key] = PatchKernel(self.waves, patch.offset_mm)
        return self._kernels[patch.key]

    def _fit(self) -> WaveModel:
        """Fit the waves to patches of the commonest shapes, spread over the surface."""
        common = {key for key, _ in Counter(patch.key for patch in self.patches.values()).most_common(FIT_SHAPES)}
        patches = [patch for patch in self.patches.values() if patch.key in common]
        spread = evenly_spread(len(patches), FIT_PATCHES)
        some = evenly_spread(len(self.frequency_hz), FIT_FREQUENCIES)

        def values(rows: Int64Array) -> Complex128Array:
            return np.asarray(self.values[rows][..., some].transpose(2, 0, 1))

        chosen = [patches[index] for index in spread]
        return fit_waves(chosen, self.frequency_hz[some], values, self.spacing_mm).at(self.frequency_hz)


def have_neighbours(position_mm: Float64Array, furthest_spacing_mm: float) -> BoolArray:
    """Positions that have neighbours to be predicted from, none where the grid's spacing is above a bound."""
    patches, spacing_mm = _patches(position_mm, np.ones(len(position_mm), dtype=bool))
    found = np.zeros(len(position_mm), dtype=bool)
    found[list(patches) if spacing_mm <= furthest_spacing_mm else []] = True
    return found


def _patches(position_mm: Float64Array, usable: BoolArray) -> tuple[dict[int, Patch], float]:
    rows = np.flatnonzero(usable).astype(np.int64)
    if len(rows) <= MIN_NEIGHBOURS:
        return {}, 0.0
    place_mm = position_mm[rows]
    distance_mm, index = _nearest(place_mm, min(2 * MAX_NEIGHBOURS, len(rows)))
    apart_mm = distance_mm[:, 1]
    if not np.any(apart_mm > 0):
        return {}, 0.0
    spacing_mm = float(np.median(apart_mm[apart_mm > 0]))
    shapes = _shapes(place_mm, distance_mm / spacing_mm, index, spacing_mm)
    return {int(rows[place]): Patch(rows[near], offset_mm, key) for place, near, offset_mm, key in shapes}, spacing_mm


def _nearest(place_mm: Float64Array, count: int) -> tuple[Float64Array, Int64Array]:
    """Distances and rows of the `count` nearest of places (n, 2) to each of them, itself first, (n, count)."""
    _, found = KDTree(place_mm).query(place_mm, min(count + TIES, len(place_mm)))
    near = np.sort(found, axis=1)
    across, along = (place_mm[:, None, axis] - place_mm[near, axis] for axis in (0, 1))
    apart_mm = np.sqrt(across**2 + along**2)
    order = np.argsort(apart_mm, axis=1, kind="stable")[:, :count]
    return np.take_along_axis(apart_mm, order, 1), np.take_along_axis(near, order, 1).astype(np.int64)


def _shapes(
    place_mm: Float64Array, distance: Float64Array, index: Int64Array, spacing_mm: float
) -> Iterator[tuple[int, Int64Array, Float64Array, bytes]]:
    """Patch of each position that has one; distances in grid spacings."""
    thin: dict[bytes, bool] = {}
    for place in range(len(place_mm)):
        offset = (place_mm[index[place]] - place_mm[place]) / spacing_mm
        fine = np.rint(offset / SAME_SPACINGS)
        ring = np.rint(distance[place] / SAME_SPACINGS)
        # A position measured twice is not its own neighbour.
        apart = (ring > 0) & (distance[place] <= FURTHEST_SPACINGS)
        within = int(np.count_nonzero(apart & (distance[place] <= REACH_SPACINGS)))
        count = min(max(within, WANTED_NEIGHBOURS), MAX_NEIGHBOURS)
        order = np.lexsort((np.round(np.arctan2(fine[:, 1], fine[:, 0]), 6), ring))
        chosen = order[apart[order]][:count]
        if len(chosen) < MIN_NEIGHBOURS:
            continue
        key = fine[chosen].astype(np.int64).tobytes()
        if key not in thin:
            thin[key] = on_a_line(offset[chosen])
        if thin[key]:
            continue
        near = np.concatenate([[place], index[place][chosen]])
        yield place, near, np.concatenate([np.zeros((1, 2)), offset[chosen]]) * spacing_mm, key
