"""Rows of a bank predicted from their neighbours by the bank's own waves, each position left out in turn."""

from collections import Counter
from collections.abc import Iterator

import numpy as np
from scipy.spatial import KDTree

from wavefocus.calibration import BoolArray, Complex128Array, Float64Array, Int64Array
from wavefocus.calibration.blas import one_blas_thread
from wavefocus.calibration.numerics import evenly_spread, on_a_line
from wavefocus.calibration.wave_model import Patch, PatchKernel, fit_waves

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
        if self.patches:
            self.fit(usable)

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
                weights = self._kernel(patch).left_out
                rows = np.stack([self.patches[position].rows for position in positions])
                missed = np.zeros((len(positions), *self.values.shape[1:]), dtype=np.complex128)
                for place in range(rows.shape[1]):
                    missed += self.values[rows[:, place]] * weights[:, place]
                errors[positions] = missed
                variance[positions] = self._kernel(patch).left_out_variance
        return errors, np.repeat(variance[:, None], self.values.shape[1], axis=1)

    def errors_without(self, out: BoolArray) -> tuple[Complex128Array, Float64Array]:
        """As `errors`, with all rows of some positions left out of all predictions as well.

        With T a position and those of its neighbours, C the covariance and M = (C^-1)_TT^-1: the first entry of
        M (C^-1 g)_T, and M's first.
        """
        errors, variance = self.errors()
        for position, patch in self.patches.items():
            among = out[patch.rows]
            among[0] = True
            if among[1:].any():
                left_out = np.flatnonzero(among)
                inverse = self._kernel(patch).inverse
                known = inverse[:, left_out] @ self.values[patch.rows].transpose(2, 0, 1)
                weights = np.linalg.inv(inverse[:, left_out[:, None], left_out])[:, :1]
                errors[position], variance[position] = (weights @ known)[:, 0].T, weights[:, 0, 0].real
        return errors, variance

    def _kernel(self, patch: Patch) -> PatchKernel:
        if patch.key not in self._kernels:
            self._kernels[patch.key] = PatchKernel(self.waves, patch.offset_mm)
        return self._kernels[patch.key]

    def fit(self, sound: BoolArray) -> None:
        """Fit the waves to patches of the commonest shapes, spread over the surface, all of whose rows are sound."""
        common = {key for key, _ in Counter(patch.key for patch in self.patches.values()).most_common(FIT_SHAPES)}
        patches = [patch for patch in self.patches.values() if patch.key in common]
        patches = [patch for patch in patches if sound[patch.rows].all()] or patches
        spread = evenly_spread(len(patches), FIT_PATCHES)
        some = evenly_spread(len(self.frequency_hz), FIT_FREQUENCIES)

        def values(rows: Int64Array) -> Complex128Array:
            return np.asarray(self.values[rows][..., some].transpose(2, 0, 1))

        chosen = [patches[index] for index in spread]
        with one_blas_thread():
            self.waves = fit_waves(chosen, self.frequency_hz[some], values, self.spacing_mm).at(self.frequency_hz)
        self._kernels: dict[bytes, PatchKernel] = {}


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
