"""Kernel interpolation along a path between nodes in arc length, and further rows at places between positions."""

from __future__ import annotations

import itertools
from collections import Counter, OrderedDict
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft
from scipy.spatial import cKDTree

from wavefocus.calibration.blas import one_blas_thread
from wavefocus.calibration.numerics import evenly_spread
from wavefocus.calibration.wave_model import Patch, PatchKernel, WaveModel, fit_waves
from wavefocus.rendering.arrays import Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.base import (
    NEIGHBOURS,
    Follow,
    Interpolation,
    Neighbourhoods,
    Nodes,
    OffGridError,
    SparseError,
    near,
    show_mm,
)
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.greens.interpolation.row_values import RowValues
from wavefocus.rendering.greens.source import DOUBTFUL_BITS, GreenSource, RowReader, apply_exponent, usable
from wavefocus.rendering.scene.paths import Circle, Path
from wavefocus.storage.point_status import Status

PHASE_STEP = 0.35
"""Radians that a wave may turn across half a patch from one frequency of the weights to the next: the cubic spline
between them is then right to 1e-4."""
GROWTH = 0.12
"""Towards 0 Hz, where the ridge decides, knots follow each other by this factor."""
MAX_KNOTS = 400
FADE = (1.25, 1.5)
"""Between these multiples of the band's upper end interpolated rows fade out: above its band a bank holds nothing."""
LEFT_OUT = 1e-6
"""Where no band is stated, it ends where this share of the bank's energy is left above."""
ROWS_LOOKED_AT = 4
HALF_PATCH_SPACINGS = 3.2
MIN_ROOM_SAMPLES = 16
ROOM = 4.0
"""Room for the weights' own ringing, in times that a wave takes to cross half a patch."""
SAME_MM = 1e-6
KERNELS_KEPT = 32
ROWS_KEPT = 96
SPECTRA_BYTES = 160 * 2**20


class KernelRows:
    """A bank and, behind its own positions, interpolated ones; the read interface of a bank.

    An interpolated row is the inverse transform of its neighbours' spectra, each times its weight at that
    frequency: the same weights for all actuators. What would come before the first tap or after the last is cut,
    and what lies above the bank's band.

    neighbourhoods: Its positions that may be used.
    """

    def __init__(self, measured: GreenSource, waves: WaveModel, neighbourhoods: Neighbourhoods) -> None:
        self.measured, self._reader = measured, RowReader(measured)
        self.actuator_mm, self.band_hz = measured.actuator_mm, measured.band_hz
        self.taps, self.actuators = measured.taps, measured.actuators
        self.sample_rate_hz, self.response_unit = measured.sample_rate_hz, measured.response_unit
        self._neighbourhoods = neighbourhoods
        self._points_mm: list[tuple[float, float]] = []
        self._index: dict[tuple[int, int], int] = {}
        self._anchor: list[int] = []
        self._at_anchor: dict[int, list[int]] = {}
        self._rows: OrderedDict[int, Float64Array] = OrderedDict()
        self._kernels: OrderedDict[bytes, PatchKernel] = OrderedDict()
        self._plan(waves)
        row_bytes = 16 * len(self._to_bins) * self.actuators
        self._spectrum = lru_cache(max(2 * (NEIGHBOURS + 1), SPECTRA_BYTES // row_bytes))(self._transform)

    def add(self, points_mm: Float64Array) -> Int64Array:
        """Add rows at points, float64 (n, 2), and return their numbers; a point is added once."""
        nearest, _ = self._neighbourhoods.nearest(points_mm)
        numbers = np.empty(len(points_mm), dtype=np.int64)
        for place, (x, y) in enumerate(points_mm.tolist()):
            key = (round(x / SAME_MM), round(y / SAME_MM))
            if key not in self._index:
                self._index[key] = len(self._points_mm)
                anchor = int(nearest[place])
                self._neighbourhoods.patch(anchor)  # says at once where there is none
                self._at_anchor.setdefault(anchor, []).append(len(self._points_mm))
                self._anchor.append(anchor)
                self._points_mm.append((x, y))
            numbers[place] = self.measured.positions + self._index[key]
        return numbers

    @property
    def position_mm(self) -> Float64Array:
        own = np.asarray(self.measured.position_mm, dtype=np.float64)
        return np.concatenate([own, np.asarray(self._points_mm, dtype=np.float64).reshape(-1, 2)])

    @property
    def status(self) -> NDArray[np.uint8]:
        added = np.full(len(self._points_mm), int(Status.VALID), dtype=np.uint8)
        return np.concatenate([np.asarray(self.measured.status, dtype=np.uint8), added])

    @property
    def positions(self) -> int:
        return self.measured.positions + len(self._points_mm)

    def green(self, position: int) -> NDArray[Any]:
        """Green's functions of one row, (actuators, taps): measured, or interpolated in float64."""
        if position < self.measured.positions:
            return self.measured.green(position)
        number = position - self.measured.positions
        if number not in self._rows:
            # All rows of one patch together: they share its neighbours' spectra.
            anchor = self._anchor[number]
            together = self._at_anchor[anchor]
            first = together.index(number)
            with one_blas_thread():
                self._make(self._neighbourhoods.patch(anchor), together[first : first + ROWS_KEPT])
        self._rows.move_to_end(number)
        return self._rows[number]

    def _plan(self, waves: WaveModel) -> None:
        """Choose transform length and the frequencies at which weights are worked out."""
        rate_hz = float(self.measured.sample_rate_hz)
        slowness_s_mm = float(np.median(waves.wavenumber_rad_mm.real / (2.0 * np.pi * waves.frequency_hz)))
        across_s = HALF_PATCH_SPACINGS * self._neighbourhoods.spacing_mm * slowness_s_mm
        room = min(max(int(np.ceil(ROOM * across_s * rate_hz)), MIN_ROOM_SAMPLES), self.measured.taps)
        self._samples = int(scipy_fft.next_fast_len(self.measured.taps + room, real=True))
        bins_hz = scipy_fft.rfftfreq(self._samples, 1.0 / rate_hz)
        top_hz = self._loud_hz(bins_hz) if self.band_hz is None else self.band_hz[1]
        fade_hz = np.array(FADE) * max(top_hz, float(waves.frequency_hz[-1]))
        highest_hz = min(float(fade_hz[1]), float(bins_hz[-1]))
        bins_hz = bins_hz[: int(np.searchsorted(bins_hz, highest_hz, side="right"))]
        widest_hz = max(PHASE_STEP / (2.0 * np.pi * across_s), highest_hz / MAX_KNOTS)
        lowest_hz = min(float(waves.frequency_hz[0]), widest_hz) / 4.0
        knots_hz = [0.0, lowest_hz]
        while knots_hz[-1] < highest_hz:
            knots_hz.append(knots_hz[-1] + min(GROWTH * knots_hz[-1], widest_hz))
        self._waves = waves.at(np.array(knots_hz))
        from scipy.interpolate import CubicSpline  # slow to load

        spline = CubicSpline(knots_hz, np.eye(len(knots_hz)))
        faded = 0.5 + 0.5 * np.cos(np.pi * np.clip((bins_hz - fade_hz[0]) / (fade_hz[1] - fade_hz[0]), 0.0, 1.0))
        self._to_bins = np.asarray(faded[:, None] * spline(bins_hz), dtype=np.float64)

    def _loud_hz(self, bins_hz: Float64Array) -> float:
        """Frequency above which some rows of the bank have next to nothing."""
        energy = np.zeros(len(bins_hz))
        for row in self._neighbourhoods.some_rows(ROWS_LOOKED_AT):
            energy += np.square(np.abs(scipy_fft.rfft(self._reader.read(row), self._samples, axis=1))).sum(axis=0)
        above = np.cumsum(energy[::-1])[::-1]
        loud = int(np.count_nonzero(above > LEFT_OUT * above[0]))
        return float(bins_hz[min(loud, len(bins_hz) - 1)])

    def _make(self, patch: Patch, numbers: list[int]) -> None:
        points_mm = np.array([self._points_mm[number] for number in numbers])
        offset_mm = points_mm - np.asarray(self.measured.position_mm, dtype=np.float64)[patch.rows[0]]
        weights = self._kernel(patch).weights(offset_mm)
        count, places, rows = weights.shape
        flat = weights.reshape(count, -1).view(np.float64)
        by_bin = (self._to_bins @ flat).view(np.complex128).reshape(-1, places, rows)
        spectra = np.stack([self._spectrum(row) for row in patch.rows.tolist()], axis=1)
        found = (by_bin @ spectra).transpose(1, 2, 0)
        green = scipy_fft.irfft(found, self._samples, axis=2)[:, :, : self.taps]
        green = apply_exponent(green, self._reader.exponent)
        for number, row in zip(numbers, green, strict=True):
            self._rows[number] = row
        while len(self._rows) > max(ROWS_KEPT, len(numbers)):
            self._rows.popitem(last=False)

    def _kernel(self, patch: Patch) -> PatchKernel:
        if patch.key not in self._kernels:
            self._kernels[patch.key] = PatchKernel(self._waves, patch.offset_mm)
            while len(self._kernels) > KERNELS_KEPT:
                self._kernels.popitem(last=False)
        self._kernels.move_to_end(patch.key)
        return self._kernels[patch.key]

    def _transform(self, row: int) -> Complex128Array:
        """Spectrum of a measured row, (bins, actuators), over two to the reader's exponent."""
        spectrum = scipy_fft.rfft(self._reader.read(row), self._samples, axis=1)[:, : len(self._to_bins)]
        return np.ascontiguousarray(spectrum.T)


STENCIL = 4
"""Nodes that make one point: a cubic polynomial in arc length."""
CUBIC_ERROR = 0.0177
"""Rms error of that polynomial for exp(j k s) between its middle nodes, over (k spacing)**4: the root of the mean of
((t + 1) t (t - 1) (t - 2) / 24)**2 over 0 < t < 1."""
TURN_RAD = 0.1
LOOKS_PER_SPACING = 4
"""A path is looked at so often; where it turns by more from look to look it has a corner or a gap."""
NARROWINGS = 40
INSET = 1e-6
MAX_LOOKS = 4_000_000


def node_spacing_mm(wavenumber_rad_mm: float, error: float) -> float:
    """Spacing at which a wave along the path is interpolated with an error."""
    return float((error / CUBIC_ERROR) ** (1.0 / STENCIL) / wavenumber_rad_mm)


class PathNodes:
    """Nodes along the smooth pieces of a path.

    Green's functions along a path are smooth in arc length but for its corners and gaps; no polynomial
    reaches across those.

    spacing_mm: Largest distance of neighbouring nodes along it, > 0.
    """

    arc_length_mm: Float64Array
    """Arc lengths of the nodes, ascending; at a corner two are equal."""

    def __init__(self, path: Path, spacing_mm: float) -> None:
        turn_mm = 2.0 * np.pi * path.radius_mm if isinstance(path, Circle) else 0.0
        if turn_mm > 0:
            # Every turn meets the same nodes.
            spacing_mm = turn_mm / np.ceil(turn_mm / spacing_mm)
        breaks = np.concatenate([[0.0], _corners(path, spacing_mm), [path.length_mm]])
        self._begins = breaks[:-1]
        parts: list[Float64Array] = []
        self._first: list[int] = []
        self._count: list[int] = []
        for begin, end in itertools.pairwise(breaks.tolist()):
            # No last step of next to nothing: polynomials through places that all but meet are worth nothing.
            steps = max(int(np.ceil((end - begin) / spacing_mm - 1e-3)), 1)
            step = spacing_mm if turn_mm > 0 else (end - begin) / steps
            nodes = np.append(begin + step * np.arange(steps), end)
            # A corner is exact to rounding: its two nodes lie safely on their own sides of it.
            nodes[0] += INSET * step if begin > 0 else 0.0
            nodes[-1] -= INSET * step if end < path.length_mm else 0.0
            self._first.append(sum(self._count))
            self._count.append(steps + 1)
            parts.append(nodes)
        self.arc_length_mm = np.concatenate(parts)

    def weights(self, arc_length_mm: Float64Array) -> tuple[Int64Array, Float64Array]:
        """Nodes and their weights at arc lengths.

        Returns they sum to 1; 0 for nodes that a short piece does not have.
        """
        piece = np.clip(np.searchsorted(self._begins, arc_length_mm, side="right") - 1, 0, len(self._begins) - 1)
        nodes = np.zeros((len(arc_length_mm), STENCIL), dtype=np.int64)
        weights = np.zeros((len(arc_length_mm), STENCIL))
        for number in np.unique(piece).tolist():
            chosen = np.flatnonzero(piece == number)
            first, count = self._first[number], self._count[number]
            mine = self.arc_length_mm[first : first + count]
            width = min(STENCIL, count)
            low = np.searchsorted(mine, arc_length_mm[chosen], side="right") - width // 2
            low = np.clip(low, 0, count - width)
            stencil = low[:, None] + np.arange(width)
            nodes[chosen] = first
            nodes[chosen[:, None], np.arange(width)] = first + stencil
            weights[chosen, :width] = _lagrange(mine[stencil], arc_length_mm[chosen])
        return nodes, weights


def _lagrange(at: Float64Array, wanted: Float64Array) -> Float64Array:
    """Weights (n, k) of values at `at` (n, k) for the polynomial at `wanted` (n,)."""
    weights = np.ones_like(at)
    for place in range(at.shape[1]):
        for other in range(at.shape[1]):
            if other != place:
                weights[:, place] *= (wanted - at[:, other]) / (at[:, place] - at[:, other])
    return weights


def _corners(path: Path, spacing_mm: float) -> Float64Array:
    """Arc lengths at which the path has a corner or a gap, ascending."""
    if isinstance(path, Circle):
        return np.zeros(0)
    looks = min(int(np.ceil(path.length_mm / spacing_mm * LOOKS_PER_SPACING)) + 2, MAX_LOOKS)
    along = np.linspace(0.0, path.length_mm, looks)
    points = path.point_at(along)
    step_mm = along[1]
    bend_mm = np.hypot(*(points[2:] - 2.0 * points[1:-1] + points[:-2]).T)
    found: list[float] = []
    for index in np.flatnonzero(bend_mm > TURN_RAD * step_mm).tolist():
        corner = _narrowed(path, float(along[index]), float(along[index + 2]))
        inside = 1e-6 * step_mm < corner < path.length_mm - 1e-6 * step_mm
        # One corner bends two neighbouring looks.
        if inside and (not found or corner > found[-1] + 1e-3 * step_mm):
            found.append(corner)
    return np.array(found)


def _narrowed(path: Path, begin: float, end: float) -> float:
    """Arc length of the strongest bend between two others."""
    for _ in range(NARROWINGS):
        if end - begin < 1e-9 * path.length_mm:
            break
        along = np.linspace(begin, end, 9)
        points = path.point_at(along)
        bend = np.hypot(*(points[2:] - 2.0 * points[1:-1] + points[:-2]).T)
        sharpest = 1 + int(np.argmax(bend))
        begin, end = float(along[sharpest - 1]), float(along[sharpest + 1])
    return 0.5 * (begin + end)


FIT_PATCHES, FIT_SHAPES = 24, 4
COMMON = 3
"""A shape that a third of the patches have is enough to fit the waves: each further one costs as much again."""
BANDS_PER_OCTAVE = 3
MAX_BANDS = 16
FAINT = 1e-4
"""Without a stated band: frequencies where the bank's power is above this part of its largest."""
REACH_SPACINGS = 1.5
"""Largest distance of a point from the nearest position: an irregular grid has gaps wider than its median spacing."""
PATH_ERROR = 1e-3
"""Relative error that interpolating along a path adds, at the bank's highest frequency."""


class KernelInterpolation(Interpolation):
    """Kernel ridge regression from a position and its 36 neighbours (`wavefocus.calibration.wave_model`).

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
            self.waves = fit_waves(patches, self.values.frequency_hz, self.values.of, self.neighbourhoods.spacing_mm)
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
        chosen = evenly_spread(len(patches), FIT_PATCHES)
        return [patches[index] for index in chosen]


def _bands_hz(bank: GreenSource, neighbourhoods: Neighbourhoods) -> Float64Array:
    """Frequencies a third of an octave apart over the bank's band."""
    low_hz, high_hz = bank.band_hz if bank.band_hz is not None else _loud_hz(bank, neighbourhoods)
    high_hz = min(high_hz, 0.499 * bank.sample_rate_hz)
    low_hz = max(low_hz, bank.sample_rate_hz / bank.taps, high_hz / 2.0 ** (MAX_BANDS / BANDS_PER_OCTAVE))
    if low_hz >= high_hz:
        return np.array([high_hz])
    count = int(np.ceil(BANDS_PER_OCTAVE * np.log2(high_hz / low_hz))) + 1
    return np.geomspace(low_hz, high_hz, max(count, 2))


def _loud_hz(bank: GreenSource, neighbourhoods: Neighbourhoods) -> tuple[float, float]:
    power, reader = np.zeros(bank.taps // 2 + 1), RowReader(bank)
    for row in neighbourhoods.some_rows(8):
        power += np.square(np.abs(np.fft.rfft(reader.read(row), axis=1))).sum(axis=0)
    loud = np.flatnonzero(power > FAINT * power.max()) if power.any() else np.array([1])
    step_hz = bank.sample_rate_hz / bank.taps
    return max(float(loud[0]), 1.0) * step_hz, max(float(loud[-1]), 1.0) * step_hz
