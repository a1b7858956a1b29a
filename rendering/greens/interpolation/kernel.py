"""Kernel interpolation as a scene asks for it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calibration.blas import one_blas_thread
from calibration.neighbours.wave_fit import fit_waves
from calibration.neighbours.wave_model import WaveModel
from rendering.greens.interpolation.base import Follow, Interpolation, Nodes, OffGridError, near, show_mm
from rendering.greens.interpolation.kernel_rows import KernelRows
from rendering.greens.interpolation.left_out_errors import RowValues
from rendering.greens.interpolation.neighbourhoods import NEIGHBOURS, Neighbourhoods, Patch, SparseError
from rendering.greens.interpolation.path_nodes import PathNodes, node_spacing_mm
from rendering.greens.interpolation.position_grid import PositionGrid
from rendering.greens.source import DOUBTFUL_BITS, GreenSource, read_row, usable
from rendering.scene.paths import Path

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

FIT_PATCHES, FIT_SHAPES = 24, 4
COMMON = 3
"""A shape that a third of the patches have is enough to fit the waves: each further one costs as much again."""
BANDS_PER_OCTAVE = 3
MOST_BANDS = 16
FAINT = 1e-4
"""Without a stated band: frequencies where the bank's power is above this part of its largest."""
REACH_SPACINGS = 1.5
"""Largest distance of a point from the nearest position: an irregular grid has gaps wider than its median spacing."""
PATH_ERROR = 1e-3
"""Relative error that interpolating along a path adds, at the bank's highest frequency."""


class KernelInterpolation(Interpolation):
    """Kernel ridge regression from a position and its 36 neighbours (`calibration.neighbours.wave_model`).

    The Green's functions of a moving source are interpolated twice: by the kernel to nodes along its path,
    from there by cubics in arc length, at an error of 1e-3 at the highest frequency. Rows that were not
    measured, or measured badly, are holes that the others fill.

    The waves are fitted near the points `around_mm`, float64 (n, 2). Raises InputError where the positions are too few
    or lie on one line.
    """

    name = "kernel"
    neighbourhoods: Neighbourhoods
    values: RowValues
    """Rows near the points, a third of an octave apart over the bank's band."""
    waves: WaveModel

    def __init__(self, bank: GreenSource, around_mm: Float64Array) -> None:
        status = np.asarray(bank.status)
        self._position_mm = np.asarray(bank.position_mm, dtype=np.float64)
        allowed = usable(bank) & ((status & DOUBTFUL_BITS) == 0)
        self.neighbourhoods = Neighbourhoods(self._position_mm, allowed)
        self._grid = PositionGrid(self._position_mm[allowed])
        self._row = np.flatnonzero(allowed).astype(np.int64)
        self.values = RowValues(bank, _bands_hz(bank, self.neighbourhoods))
        patches = self._patches(around_mm)
        with one_blas_thread():
            self.waves = fit_waves(patches, self.values, self.neighbourhoods.spacing_mm)
        self._rows = KernelRows(bank, self.waves, self.neighbourhoods)
        largest = float(np.max(np.abs(self.waves.wavenumber_rad_mm)))
        self._node_spacing_mm = node_spacing_mm(largest, PATH_ERROR)

    @classmethod
    def over(cls, bank: GreenSource, around_mm: Float64Array) -> Self:
        return cls(bank, around_mm)

    @classmethod
    def needed_rows(cls, grid: PositionGrid, rows: set[int], points_mm: Float64Array, step_mm: float) -> set[int]:
        """The neighbours of the nearest rows, and all that is as far away as the last of them."""
        tree, centres_mm = cKDTree(grid.position_mm), grid.position_mm[sorted(rows)]
        distance, _ = tree.query(centres_mm, k=min(NEIGHBOURS + 1, tree.n))
        furthest_mm = np.reshape(distance, (len(centres_mm), -1))[:, -1] * (1 + 1e-6) + 1e-9
        return {row for near_rows in tree.query_ball_point(centres_mm, furthest_mm) for row in near_rows}

    def nodes(self, points_mm: Float64Array) -> Nodes:
        nearest, distance_mm = self._nearest(points_mm)
        rows = self._add(points_mm)
        return Nodes(rows[:, None], np.ones((len(rows), 1)), nearest, distance_mm)

    def follow(self, path: Path, arc_length_mm: Float64Array | None = None) -> Follow:
        if path.length_mm == 0 or (
            arc_length_mm is not None and len(arc_length_mm) * self._node_spacing_mm <= path.length_mm
        ):
            return lambda along: self.nodes(path.point_at(along))
        along_path = PathNodes(path, self._node_spacing_mm)
        rows = self._add(path.point_at(along_path.arc_length_mm))

        def follow(along: Float64Array) -> Nodes:
            nearest, distance_mm = self._nearest(path.point_at(along))
            nodes, weights = along_path.weights(along)
            return Nodes(rows[nodes], weights, nearest, distance_mm)

        return follow

    def rows_of(self, bank: GreenSource) -> GreenSource:
        return self._rows

    def _nearest(self, points_mm: Float64Array) -> tuple[Int64Array, Float64Array]:
        rows, distance_mm = near(self._grid, points_mm, REACH_SPACINGS)
        return self._row[rows], distance_mm

    def _add(self, points_mm: Float64Array) -> Int64Array:
        near(self._grid, points_mm, REACH_SPACINGS)
        try:
            return self._rows.add(points_mm)
        except SparseError as error:
            nearest, _ = self.neighbourhoods.nearest(points_mm)
            sparse = np.array([self._is_sparse(int(row)) for row in nearest])
            point = int(np.argmax(sparse))
            raise OffGridError(point, f"lies at {show_mm(points_mm[point])} mm, but {error}") from error

    def _is_sparse(self, row: int) -> bool:
        try:
            self.neighbourhoods.patch(row)
        except SparseError:
            return True
        return False

    def _patches(self, around_mm: Float64Array) -> Sequence[Patch]:
        """Some patches around the points, of the commonest shape if it is common; the rim shows waves less well."""
        anchors = np.unique(self.neighbourhoods.nearest(around_mm)[0]).tolist()
        patches = [self.neighbourhoods.patch(row) for row in anchors if not self._is_sparse(row)]
        if not patches:
            return [self.neighbourhoods.patch(anchors[0])]  # which says what is wrong
        shapes = Counter(patch.key for patch in patches).most_common(FIT_SHAPES)
        common = {shape for shape, _ in (shapes[:1] if COMMON * shapes[0][1] >= len(patches) else shapes)}
        patches = [patch for patch in patches if patch.key in common]
        chosen = np.unique(np.linspace(0, len(patches) - 1, FIT_PATCHES).astype(np.int64))
        return [patches[index] for index in chosen]


def _bands_hz(bank: GreenSource, neighbourhoods: Neighbourhoods) -> Float64Array:
    """Frequencies a third of an octave apart over the bank's band."""
    low_hz, high_hz = bank.band_hz if bank.band_hz is not None else _loud_hz(bank, neighbourhoods)
    high_hz = min(high_hz, 0.499 * bank.sample_rate_hz)
    low_hz = max(low_hz, bank.sample_rate_hz / bank.taps, high_hz / 2.0 ** (MOST_BANDS / BANDS_PER_OCTAVE))
    if low_hz >= high_hz:
        return np.array([high_hz])
    count = int(np.ceil(BANDS_PER_OCTAVE * np.log2(high_hz / low_hz))) + 1
    return np.geomspace(low_hz, high_hz, max(count, 2))


def _loud_hz(bank: GreenSource, neighbourhoods: Neighbourhoods) -> tuple[float, float]:
    power = np.zeros(bank.taps // 2 + 1)
    for row in neighbourhoods.some_rows(8):
        power += np.square(np.abs(np.fft.rfft(read_row(bank, row).values, axis=1))).sum(axis=0)
    loud = np.flatnonzero(power > FAINT * power.max()) if power.any() else np.array([1])
    step_hz = bank.sample_rate_hz / bank.taps
    return max(float(loud[0]), 1.0) * step_hz, max(float(loud[-1]), 1.0) * step_hz
