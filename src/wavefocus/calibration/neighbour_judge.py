"""Rows of a bank against their predictions from the other positions: which differ, and in what.

Every position is predicted with its own rows left out: from its neighbours (`_RowsPredicted`) or, on coarse
grids, from all others by waves (`coarse_grid.left_out_rows`). A prediction's usual error is that of the positions
around. What is farther off is left out of all other predictions, the worst first, and then compared again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from wavefocus.calibration import BoolArray, Complex128Array, Float64Array, Int64Array
from wavefocus.calibration.coarse_grid.left_out_rows import RowsByWaves, waves_of_rows
from wavefocus.calibration.evidence import MAJORITY, MOST, ROW_CHANGE, SEEN_SHARE
from wavefocus.calibration.numerics import evenly_spread, on_a_line, one_blas_thread, transform_at
from wavefocus.calibration.wave_model import Patch, PatchKernel, every_second, fit_waves

if TYPE_CHECKING:
    from wavefocus.calibration.coarse_grid.rim_waves import WavesFound

REACH_SPACINGS = 2.6
"""Neighbours are this near, in grid spacings: 20 on a square grid, 18 on a hexagonal one."""
FURTHEST_SPACINGS = 4.5
"""At the rim, where fewer are so near, they may be this far."""
MIN_NEIGHBOURS, WANTED_NEIGHBOURS, MAX_NEIGHBOURS = 8, 14, 24
SAME_SPACINGS = 1e-3
FIT_PATCHES, FIT_SHAPES, FIT_FREQUENCIES = 12, 2, 11
TIES = 12
"""Positions of a lattice that may be equally far; of those at the edge the first rows are taken."""


class _RowsPredicted:
    """Leave-one-out predictions of all rows of a bank.

    A row is predicted by kernel regression over the bank's own waves (`wavefocus.calibration.wave_model`) from the
    rows of its neighbours, actuator by actuator and frequency by frequency.

    position_mm, float64 (positions, 2): Grid in millimetres.
    values, complex128 (positions, actuators, frequencies): Fourier transforms of the rows.
    frequency_hz, float64 (frequencies,): Ascending, > 0.
    usable, bool (positions,): Rows that are there; the others are holes.

    spacing_mm: Median distance of neighbouring positions; 0 where there are fewer than two.
    patches: The positions that can be predicted at all.
    neighbours: Of each of these, itself and the rows that it is predicted from.
    """

    def __init__(
        self, position_mm: Float64Array, values: Complex128Array, frequency_hz: Float64Array, usable: BoolArray
    ) -> None:
        self._values = values
        self._frequency_hz = frequency_hz
        self.patches, self.spacing_mm = _patches(position_mm, usable)
        self.neighbours = {position: patch.rows for position, patch in self.patches.items()}
        if self.patches:
            self.fit(usable)

    def errors_without(self, out: BoolArray) -> tuple[Complex128Array, Float64Array]:
        """Error of every row, left out together with some positions, and its expected square for a field of strength 1.

        With T a position and those of its neighbours that are out, C the covariance and M = (C^-1)_TT^-1: the first
        entry of M (C^-1 g)_T, and M's first.

        Returns errors, complex128 (positions, actuators, frequencies): what the row has more than its prediction; NaN
        where there is none; variance, float64 of that shape, the same for all actuators.
        """
        errors, variance = np.full(self._values.shape, np.nan + 0j), np.full(self._values.shape, np.nan)
        by_shape: dict[bytes, list[int]] = {}
        for position, patch in self.patches.items():
            by_shape.setdefault(patch.key, []).append(position)
        with one_blas_thread():
            for positions in by_shape.values():
                kernel = self._kernel(self.patches[positions[0]])
                rows = np.stack([self.patches[position].rows for position in positions])
                missed = np.zeros((len(positions), *self._values.shape[1:]), dtype=np.complex128)
                for place in range(rows.shape[1]):
                    missed += self._values[rows[:, place]] * kernel.left_out[:, place]
                errors[positions], variance[positions] = missed, kernel.left_out_variance
        for position, patch in self.patches.items():
            among = out[patch.rows]
            among[0] = True
            if among[1:].any():
                left_out, inverse = np.flatnonzero(among), self._kernel(patch).inverse
                known = inverse[:, left_out] @ self._values[patch.rows].transpose(2, 0, 1)
                weights = np.linalg.inv(inverse[:, left_out[:, None], left_out])[:, :1]
                errors[position], variance[position] = (weights @ known)[:, 0].T, weights[:, 0, 0].real
        return errors, variance

    def _kernel(self, patch: Patch) -> PatchKernel:
        if patch.key not in self._kernels:
            self._kernels[patch.key] = PatchKernel(self._waves, patch.offset_mm)
        return self._kernels[patch.key]

    def fit(self, sound: BoolArray) -> None:
        """Fit the waves to patches of the commonest shapes, spread over the surface, all of whose rows are sound."""
        common = {key for key, _ in Counter(patch.key for patch in self.patches.values()).most_common(FIT_SHAPES)}
        patches = [patch for patch in self.patches.values() if patch.key in common]
        patches = [patch for patch in patches if sound[patch.rows].all()] or patches
        spread = evenly_spread(len(patches), FIT_PATCHES)
        some = every_second(evenly_spread(len(self._frequency_hz), FIT_FREQUENCIES))

        def values(rows: Int64Array) -> Complex128Array:
            return np.asarray(self._values[rows][..., some].transpose(2, 0, 1))

        chosen = [patches[index] for index in spread]
        with one_blas_thread():
            self._waves = fit_waves(chosen, self._frequency_hz[some], values, self.spacing_mm).at(self._frequency_hz)
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


LINEAR_FREQUENCIES, OCTAVE_FREQUENCIES = 16, 16
POSITION_DIFFERS = 0.1
"""Error over prediction from which on all rows of a position differ: -3 dB leave 0.29, half a spacing of a fine grid
some 0.2. A single row differs from 0.4 on: `ROW_CHANGE` but for `SEEN_SHARE`."""
USUAL = 4.0
"""And it is so many times the usual error: the maximum of a thousand normal errors is 3.3 standard deviations. Rows
whose usual error would reach the row itself then are not judged."""
AROUND = 12
"""The usual error is the median of so many nearest positions."""
NEAR_SPACINGS, NEAR_SPACINGS_OF_WAVES = 4.0, 2.0
"""Nearer to its actuator than so many grid spacings, a row is not judged: the field there is not of passing waves."""
MIN_COARSE_MM, TRUSTED = 5.0, 0.7
"""On grids coarser than this, a nominal gel's half wavelength at 480 Hz, waves predict where neighbours can judge a
smaller share of the rows."""
ROUNDS = 60

Kind = Literal["level", "polarity", "swapped", "elsewhere", "other"]


@dataclass(frozen=True, slots=True)
class NeighbourDifference:
    """Rows that are not what the other positions say.

    position: The position.
    actuators: The actuators whose rows differ.
    kind: ``"level"``, ``"polarity"``, ``"swapped"`` (the rows are each other's), ``"elsewhere"`` (all rows differ, by
        no common factor), or ``"other"``.
    relative: Difference over prediction, L2 norms within the band.
    level_db: Of the rows relative to their predictions, where the kind has it.
    whole: Whether all of the position's rows differ.
    """

    position: int
    actuators: tuple[int, ...]
    kind: Kind
    relative: float
    level_db: float = 0.0
    whole: bool = False

    @property
    def sentence(self) -> str:
        """The difference in words, without the position's number."""
        single = not self.whole and len(self.actuators) == 1
        rows = "all responses" if self.whole else f"the responses of actuators {', '.join(map(str, self.actuators))}"
        if single:
            rows = f"the response of actuator {self.actuators[0]}"
        verb, its = ("differs", "its prediction") if single else ("differ", "their predictions")
        if self.kind == "swapped":
            return f"{rows} are swapped" if len(self.actuators) > 1 else f"{rows} is that of another actuator"
        if self.kind == "elsewhere":
            return f"{rows} are those of another place: {100 * self.relative:.0f} % from {its}"
        what = {"level": f" by {self.level_db:+.1f} dB", "polarity": " in polarity"}
        return (
            f"{rows} {verb}{what.get(self.kind, f' by {100 * self.relative:.0f} %')} from {its} by the other positions"
        )


@dataclass(frozen=True, slots=True)
class NeighbourResult:
    """All that differs in a bank.

    differences: By position.
    judged, bool (positions, actuators): Rows that could be judged.
    by_waves: Whether waves from all other positions predicted them, not the neighbours.
    """

    differences: tuple[NeighbourDifference, ...]
    judged: BoolArray
    by_waves: bool = False


class RowsAtFrequencies:
    """Fourier transforms of rows at some frequencies of a band.

    positions, actuators, taps: Size of the bank.
    sample_rate_hz: Its rate in Hz.
    band_hz: Its band; by default up to 0.45 of the rate.

    frequency_hz, float64 (frequencies,): Ascending: as many evenly spaced as by octaves.
    values, complex128 (positions, actuators, frequencies): Zeros where nothing was set.
    """

    def __init__(
        self, positions: int, actuators: int, taps: int, sample_rate_hz: float, band_hz: tuple[float, float] | None
    ) -> None:
        low_hz, high_hz = (0.0, 0.45 * sample_rate_hz) if band_hz is None else band_hz
        high_hz = min(0.97 * high_hz, 0.48 * sample_rate_hz)
        low_hz = min(max(1.2 * low_hz, 1.5 * sample_rate_hz / taps, high_hz / 1000.0), 0.5 * high_hz)
        octaves = np.geomspace(low_hz, high_hz, OCTAVE_FREQUENCIES + 2)[1:-1]
        self.frequency_hz: Float64Array = np.sort(
            np.concatenate([np.linspace(low_hz, high_hz, LINEAR_FREQUENCIES), octaves])
        )
        self._rate_hz = sample_rate_hz
        self.values: Complex128Array = np.zeros((positions, actuators, len(self.frequency_hz)), dtype=np.complex128)

    def set(self, position: int, green: NDArray[np.floating]) -> None:
        """Take a position's rows, (actuators, taps)."""
        peak, hertz = float(np.abs(green).max(initial=0.0)), self.frequency_hz
        there = 0 < peak < np.inf
        self.values[position] = (
            transform_at((green / peak).astype(np.float32), hertz, self._rate_hz) * peak if there else 0
        )


def judge_rows(
    position_mm: Float64Array,
    actuator_mm: Float64Array,
    spectra: RowsAtFrequencies,
    usable: BoolArray,
    modelled: BoolArray | None = None,
    waves: Callable[[], WavesFound | None] | None = None,
) -> NeighbourResult:
    """Judge the rows of a bank by all others.

    position_mm, float64 (positions, 2): Grid in millimetres.
    actuator_mm, float64 (actuators, 2): Actuators in millimetres, NaN where unknown.
    spectra: The rows.
    usable, bool (positions,): Rows that neighbours predict and judge.
    modelled, bool (positions,): Rows that waves predict and judge where the grid is too coarse for neighbours and the
        actuators' places are known; those off the grid, too. By default only neighbours judge.
    waves: Gives the waves of rows that are right; None for none. By default they are found from the rows that count.
    """
    there = (np.abs(spectra.values).max(axis=(1, 2), initial=0.0) > 0) & np.isfinite(position_mm).all(axis=1)
    largest = np.abs(spectra.values[there]).max(initial=0.0)
    values = spectra.values / largest if largest > 0 else spectra.values
    measured = position_mm, actuator_mm, values, spectra.frequency_hz
    with one_blas_thread():
        neighbours = _RowsPredicted(position_mm, values, spectra.frequency_hz, usable & there)
        judge = _Judge(*measured, neighbours)
        wanted = there & (np.zeros_like(there) if modelled is None else modelled)
        coarse = neighbours.spacing_mm > MIN_COARSE_MM or not neighbours.patches
        if not (wanted.any() and coarse and judge.judged[usable & there].mean() < TRUSTED):
            return judge.find()
        verdict = _by_waves(measured, wanted, waves() if waves else waves_of_rows(*measured, wanted))
        if verdict is not None and verdict.differences and waves is None:
            # Wrong rows had a part in the waves that were found.
            sound = wanted & ~np.isin(np.arange(len(wanted)), [one.position for one in verdict.differences])
            verdict = _by_waves(measured, wanted, waves_of_rows(*measured, sound)) or verdict
        return verdict or judge.find()


_Measured = tuple[Float64Array, Float64Array, Complex128Array, Float64Array]


def _by_waves(measured: _Measured, rows: BoolArray, found: WavesFound | None) -> NeighbourResult | None:
    """Judge by waves; None where none fit."""
    with suppress(np.linalg.LinAlgError):
        if found is not None:
            return _Judge(*measured, RowsByWaves(*measured, rows, found)).find()
    return None


class _Judge:
    """Errors of all rows, with what differs left out, and what of them is usual."""

    def __init__(
        self,
        position_mm: Float64Array,
        actuator_mm: Float64Array,
        values: Complex128Array,
        frequency_hz: Float64Array,
        rows: _RowsPredicted | RowsByWaves,
    ) -> None:
        self._values, self._rows = values, rows
        self.by_waves = isinstance(rows, RowsByWaves)
        self._positions = np.array(sorted(rows.neighbours), dtype=np.int64)
        self._around = {row: near[1 : 1 + AROUND] for row, near in rows.neighbours.items()}
        self._out: BoolArray = np.zeros(len(values), dtype=bool)
        loudest = np.argsort(-np.square(np.abs(values)).sum(axis=2), axis=0)[:3]
        source_mm = np.where(np.isfinite(actuator_mm), actuator_mm, np.median(position_mm[loudest], axis=0))
        spacings = NEAR_SPACINGS_OF_WAVES if self.by_waves else NEAR_SPACINGS
        apart_mm = np.hypot(*(position_mm[:, None] - source_mm).transpose(2, 0, 1))
        self._far: BoolArray = np.asarray(apart_mm > spacings * rows.spacing_mm)
        self.judged: BoolArray = np.zeros(values.shape[:2], dtype=bool)
        if self._positions.size:
            self._predict()

    def _predict(self) -> None:
        """Errors without what is left out, over the prediction, and over the usual ones."""
        errors, variance = self._rows.errors_without(self._out)
        self.errors: Complex128Array = errors
        predicted = np.linalg.norm(self._values - errors, axis=2)
        self._relative: Float64Array = np.linalg.norm(errors, axis=2) / np.maximum(predicted, 1e-300)
        own = np.sqrt((np.square(np.abs(errors)) / np.maximum(variance, 1e-300)).mean(axis=2))
        usual = np.full_like(own, np.nan)
        for row, near in self._around.items():
            known = near[~self._out[near]]
            usual[row] = np.median(own[known], axis=0) if known.size else np.nan
        self._times: Float64Array = own / np.maximum(usual, 1e-300)
        # What is wrong spoils the predictions of all around it, so that they show it less than the rest of the surface.
        everywhere = np.median(own[self._positions], axis=0)
        self._at_most: Float64Array = own / np.maximum(np.fmin(usual, everywhere), 1e-300)
        self.judged = self._far & (self._relative < self._times / USUAL) & np.isfinite(self._times)

    def _scores(self, *, strict: bool) -> tuple[Float64Array, BoolArray, BoolArray]:
        """By how many usual errors each position differs, 0 where it does not; whether all of it; and which rows."""
        judged, times = (self.judged, self._times) if strict else (self._far, self._at_most)
        relative, times = (np.where(judged, figure, np.nan) for figure in (self._relative, times))
        enough = np.isfinite(relative).sum(axis=1) >= MAJORITY
        middle, middle_times = np.zeros((2, len(relative)))
        middle[enough], middle_times[enough] = (np.nanmedian(f[enough], axis=1) for f in (relative, times))
        whole = (middle > POSITION_DIFFERS) & (middle_times > USUAL)
        rows = (np.nan_to_num(relative) > SEEN_SHARE * ROW_CHANGE) & (np.nan_to_num(times) > USUAL)
        worst_row = np.where(rows, np.nan_to_num(times), 0.0).max(axis=1, initial=0.0)
        return np.maximum(np.where(whole, middle_times, 0.0), worst_row), whole, rows

    def find(self) -> NeighbourResult:
        """Leave out the worst of each neighbourhood until none may be wrong, then take back what agrees without it."""
        for _ in range(ROUNDS if self._positions.size else 0):
            score = np.where(self._out, 0.0, self._scores(strict=False)[0])
            suspect = np.flatnonzero(score).tolist()
            worst = [row for row in suspect if score[row] >= score[self._around[row]].max(initial=0.0)]
            if not worst:
                break
            self._out[worst] = True
            if self._out.sum() > MOST * self._positions.size:
                return NeighbourResult((), np.zeros_like(self.judged), self.by_waves)
            self._predict()
        for _ in range(2 if self._out.any() else 0):
            if isinstance(self._rows, _RowsPredicted):
                self._rows.fit(~self._out)
                self._predict()
            unjudged = (self._far & ~self.judged).any(axis=1) & (self._scores(strict=False)[0] > 0)
            self._out &= unjudged | (self._scores(strict=True)[0] > 0)
            self._predict()
        if not self._out.any():
            return NeighbourResult((), self.judged, self.by_waves)
        score, whole, rows = self._scores(strict=True)
        wrong = np.flatnonzero(self._out & (score > 0)).tolist()
        found = [one for row in wrong for one in self._named(row, rows[row], whole=bool(whole[row]))]
        return NeighbourResult(tuple(found), self.judged, self.by_waves)

    def _named(self, position: int, rows: BoolArray, *, whole: bool) -> list[NeighbourDifference]:
        values, predicted = self._values[position], self._values[position] - self.errors[position]
        judged = np.flatnonzero(self.judged[position])
        if whole or (rows.sum() >= MAJORITY and 2 * rows.sum() > judged.size):
            size = np.linalg.norm(predicted[judged], axis=1, keepdims=True)
            kind, level_db, _ = _factor(values[judged] / size, predicted[judged] / size)
            relative = float(np.median(self._relative[position, judged]))
            which = tuple(judged.tolist())
            return [NeighbourDifference(position, which, kind or "elsewhere", relative, level_db, whole=True)]
        found: list[NeighbourDifference] = []
        other: dict[int, int] = {}
        for actuator in np.flatnonzero(rows).tolist():
            kind, level_db, share = _factor(values[actuator], predicted[actuator])
            left = np.square(np.abs(values[actuator] - predicted)).sum(axis=1)
            left = np.nan_to_num(left / left[actuator], nan=np.inf)
            nearest = int(np.argmin(left))
            if left[nearest] < min(share, 1 - SEEN_SHARE):
                kind, level_db, other[actuator] = "swapped", 0.0, nearest
            relative = float(self._relative[position, actuator])
            found.append(NeighbourDifference(position, (actuator,), kind or "other", relative, level_db))
        pairs = {(min(a, b), max(a, b)) for a, b in other.items() if other.get(b) == a}
        kept = [one for one in found if not any(one.actuators[0] in pair for pair in pairs)]
        return kept + [
            NeighbourDifference(position, pair, "swapped", float(self._relative[position, list(pair)].max()))
            for pair in sorted(pairs)
        ]


def _factor(values: Complex128Array, predicted: Complex128Array) -> tuple[Kind | None, float, float]:
    """A level or a polarity that explains a difference, the level in dB, and the share of it that is left."""
    factor = float(np.vdot(predicted, values).real) / max(float(np.vdot(predicted, predicted).real), 1e-300)
    differs, left = (float(np.square(np.abs(values - share * predicted)).sum()) for share in (1.0, factor))
    share = left / max(differs, 1e-300)
    if share > 1 - SEEN_SHARE:
        return None, 0.0, share
    return "level" if factor > 0 else "polarity", 20 * float(np.log10(max(abs(factor), 1e-10))), share
