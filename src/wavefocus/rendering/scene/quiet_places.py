"""Where a scene is to be quiet: places and rows, instant by instant, and the sources that keep away from them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wavefocus.config.scene import INDEPENDENT_LEVEL_DB
from wavefocus.rendering.arrays import BoolArray, Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.base import (
    GridInterpolation,
    Interpolation,
    OffGridError,
    bank_grid,
    interpolation_method,
    near,
    show_mm,
)
from wavefocus.rendering.greens.interpolation.errors import ON_POSITION, choose_interpolation, errors_at
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.greens.source import GreenSource, refusal, usable
from wavefocus.rendering.scene.model import Scene
from wavefocus.rendering.scene.paths import Path
from wavefocus.rendering.scene.sampling import SampledScene
from wavefocus.rendering.scene.trajectory import TrajectoryPath
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.reader import DamagedError

SEGMENT_S = 0.01
"""Filters follow places that move in steps of this, and fade from step to step."""
RING, RING_ROWS = 0.8, 8
"""A disc of a fingertip's size that is quiet at its centre and on this part of its radius is quiet all over."""


@dataclass(frozen=True, slots=True, eq=False)
class PlannedPlace:
    """A place that is to be quiet.

    words: Its name in messages, "quiet[0]", or "source 1" where sources are independent.
    level: Energy of the response there over that at the loudest focus.
    source: The source that sounds there, which need not be quiet; None for a quiet place.
    """

    words: str
    path: Path
    speed_mm_s: float
    start_s: float
    radius_mm: float
    level_db: float
    source: int | None = None

    @property
    def level(self) -> float:
        return float(10.0 ** (self.level_db / 10.0))

    def at(self, sample: Int64Array, rate_hz: float) -> Float64Array:
        """Where it is at samples of scene time, float64 (n, 2)."""
        return place_at(self.path, self.speed_mm_s, self.start_s, sample, rate_hz)


def place_at(path: Path, speed_mm_s: float, start_s: float, sample: Int64Array, rate_hz: float) -> Float64Array:
    """Points of a path that is followed from `start_s` on at samples of scene time; before and after it, its ends."""
    if isinstance(path, TrajectoryPath):
        # Between two strokes it is where the former one ended.
        return path.trajectory(start_s, rate_hz, of_strokes=True).at(path.on_stroke(sample, start_s, rate_hz)[1])[0]
    moves = path.length_mm > 0 and speed_mm_s > 0
    along_mm = np.clip(speed_mm_s * (sample / rate_hz - start_s), 0.0, path.length_mm) if moves else 0.0 * sample
    return path.point_at(along_mm)


def changes_place(path: Path) -> bool:
    """Whether a path has more places than one; a trajectory that only rests between jumps has no length."""
    return path.length_mm > 0 or (isinstance(path, TrajectoryPath) and len(set(path.points_mm)) > 1)


def places_of(scene: Scene) -> tuple[PlannedPlace, ...]:
    """The quiet places of a scene, and those of its sources where they are independent."""
    places = [
        PlannedPlace(f"quiet[{index}]", quiet.path, quiet.speed_mm_s, 0.0, quiet.radius_mm, quiet.level_db)
        for index, quiet in enumerate(scene.quiet)
    ]
    if scene.regularisation.independent and len(scene.sources) > 1:
        places += [
            PlannedPlace(
                f"source {index}", source.path, source.speed_mm_s, source.start_s, 0.0, INDEPENDENT_LEVEL_DB, index
            )
            for index, source in enumerate(scene.sources)
        ]
    return tuple(places)


def paths_of(scene: Scene, places: tuple[PlannedPlace, ...]) -> list[Path]:
    """Paths of all places and sources."""
    return [*(place.path for place in places), *(source.path for source in scene.sources)]


def _disc_mm(radius_mm: float) -> Float64Array:
    """Points about (0, 0) at which a disc is kept quiet, float64 (n, 2): its centre and a ring; one for radius 0."""
    if radius_mm == 0:
        return np.zeros((1, 2))
    angle = 2.0 * np.pi * np.arange(RING_ROWS) / RING_ROWS
    ring = RING * radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.zeros((1, 2)), ring])


class PlaceRows:
    """Rows at places of a bank: a position's own row at the position, interpolated ones between positions.

    own: The scene's own interpolation, used where it makes rows of its own.
    name: The method that is used else; by default what "auto" takes.
    """

    rows: GreenSource
    """The bank whose rows `at` refers to."""

    def __init__(self, bank: GreenSource, own: Interpolation | None = None, name: str | None = None) -> None:
        self._bank, self.rows = bank, bank
        self._grid, self._status = PositionGrid(bank.position_mm), np.asarray(bank.status)
        self._reach = bank_grid(bank)
        self._method = None if isinstance(own, GridInterpolation) else own
        self.name = name or ("auto" if self._method is None else self._method.name)
        self._between_mm: list[Float64Array] = []

    def at(self, points_mm: Float64Array) -> Int64Array:
        """Rows (n,) at points (n, 2). Raises OffGridError: a point is off the grid, or nothing is measured there."""
        near(self._reach, points_mm)
        rows, distance_mm = self._grid.nearest(points_mm)
        between = (distance_mm > ON_POSITION * self._grid.spacing_mm) | ~usable(self._bank)[rows]
        if between.any() and self._method is None:
            try:
                self._method = (
                    choose_interpolation(self._bank, points_mm[between])
                    if self.name == "auto"
                    else interpolation_method(self.name).over(self._bank, points_mm[between])
                )
                self.name = self._method.name
            except DamagedError:
                raise
            except InputError:
                pass  # where the bank allows none, the nearest positions are taken
        if between.any() and self._method is not None:
            rows = rows.copy()
            rows[between] = self._method.nodes(points_mm[between]).rows[:, 0]
            self.rows = self._method.rows_of(self._bank)
            self._between_mm.append(points_mm[between])
            return rows
        near(self._reach, points_mm, amid_cells=False)
        for point, row in enumerate(rows.tolist()):
            if reason := refusal(int(self._status[row])):
                raise OffGridError(point, f"needs position {row} at {show_mm(points_mm[point])} mm, which is {reason}")
        return rows

    def error(self, signals: Sequence[Float64Array]) -> float:
        """Estimated relative error of the rows between positions for what is emitted; 0 where there is none."""
        if not self._between_mm or self._method is None:
            return 0.0
        found = errors_at(self._bank, self._method, np.concatenate(self._between_mm), signals)
        return 0.0 if found is None else found.overall


QuietSet = tuple[int, Int64Array, Int64Array]
"""A source, the rows that it keeps quiet at an instant, of `PlaceRows`, and the place of each, int64 (rows,)."""


@dataclass(frozen=True, slots=True, eq=False)
class QuietPlan:
    """Which source is quiet where and when.

    knots, int64 (knots,): Samples of scene time, equally spaced; one where nothing changes.
    place_rows: Rows of each place at the knots, int64 (knots, rows).
    sets: All sets of rows, none twice.
    of_source, int64 (sources, knots): Set of each source at each knot.
    warnings: Of places that a source passes.
    """

    places: tuple[PlannedPlace, ...]
    knots: Int64Array
    place_rows: tuple[Int64Array, ...]
    sets: tuple[QuietSet, ...]
    of_source: Int64Array
    warnings: tuple[str, ...]

    def rows_at(self, knot: int) -> tuple[Int64Array, Int64Array]:
        """Rows of all places at a knot, and the place of each."""
        rows = [np.asarray(rows_of_place[knot]) for rows_of_place in self.place_rows]
        return np.concatenate(rows), np.repeat(np.arange(len(rows)), [len(rows_of_place) for rows_of_place in rows])


def plan_quiet(scene: Scene, bank: GreenSource, sampled: SampledScene, place_rows: PlaceRows) -> QuietPlan:
    """Find the rows of all places at all instants.

    Raises InputError: a quiet place is at a focus or off the grid, or there are too many.
    """
    places, rate_hz = places_of(scene), float(bank.sample_rate_hz)
    emissions = [source.emission for source in sampled.sources]
    first = min(emission.first_sample for emission in emissions)
    stop = max(emission.stop_sample for emission in emissions)
    moving = any(changes_place(path) for path in paths_of(scene, places))
    apart = len({(emission.first_sample, emission.stop_sample) for emission in emissions}) > 1
    segment = max(1, round(SEGMENT_S * rate_hz))
    knots = np.arange(first, stop + segment, segment) if moving or apart else np.array([first])
    rows = tuple(_rows(place, knots, rate_hz, place_rows) for place in places)
    total = sum(rows_of_place.shape[1] for rows_of_place in rows)
    pairs = total * len(scene.sources)
    # Of all places, of rows and sources, and of these at all instants: more would take hours.
    if total > 2000 or pairs > 20_000 or pairs * len(knots) > (10**8):
        raise InputError(
            f"{len(places)} quiet places of {total} rows for {len(scene.sources)} sources are too many; use fewer"
            " places or sources, or a shorter scene"
        )
    warnings: list[str] = []
    applies = _applies(scene, places, sampled, knots, rate_hz, warnings)
    sets: list[QuietSet] = []
    of_source = np.zeros((len(scene.sources), len(knots)), dtype=np.int64)
    place_of = np.repeat(np.arange(len(places)), [rows_of_place.shape[1] for rows_of_place in rows])
    for source in range(len(scene.sources)):
        used = np.concatenate(
            [np.where(applies[source, index][:, None], rows_of_place, -1) for index, rows_of_place in enumerate(rows)],
            axis=1,
        )
        different, inverse = np.unique(used, axis=0, return_inverse=True)
        # None is that of another source.
        of_source[source] = len(sets) + inverse.ravel()
        sets += [(source, one[one >= 0], place_of[one >= 0]) for one in different]
    return QuietPlan(places, knots, rows, tuple(sets), of_source, tuple(warnings))


def _rows(place: PlannedPlace, knots: Int64Array, rate_hz: float, place_rows: PlaceRows) -> Int64Array:
    """Rows of a place at all knots, (knots, rows); a point that moves has those of the knots beside, too."""
    at_mm = place.at(knots, rate_hz)
    around_mm = _disc_mm(place.radius_mm)
    points_mm = (at_mm[:, None] + around_mm).reshape(-1, 2)
    try:
        rows = place_rows.at(points_mm).reshape(len(knots), len(around_mm))
    except OffGridError as off:
        raise InputError(f"{place.words} {off}") from off
    if place.radius_mm == 0 and changes_place(place.path) and len(knots) > 1:
        before, after = np.concatenate([rows[:1], rows[:-1]]), np.concatenate([rows[1:], rows[-1:]])
        rows = np.concatenate([rows, before, after], axis=1)
    return rows


def _applies(
    scene: Scene,
    places: tuple[PlannedPlace, ...],
    sampled: SampledScene,
    knots: Int64Array,
    rate_hz: float,
    warnings: list[str],
) -> BoolArray:
    """Whether a source is quiet at a place at a knot, (sources, places, knots)."""
    applies = np.ones((len(scene.sources), len(places), len(knots)), dtype=bool)
    at_mm = [place.at(knots, rate_hz) for place in places]
    segment = int(knots[1] - knots[0]) if len(knots) > 1 else 1
    for index, source in enumerate(scene.sources):
        emission = sampled.sources[index].emission
        sounds = (knots > emission.first_sample - segment) & (knots < emission.stop_sample + segment)
        own_mm = place_at(source.path, source.speed_mm_s, source.start_s, knots, rate_hz)
        for number, place in enumerate(places):
            if place.source == index:
                applies[index, number] = False
                continue
            if place.source is not None:
                other = sampled.sources[place.source].emission
                applies[index, number] &= (knots > other.first_sample - segment) & (knots < other.stop_sample + segment)
            rests = not changes_place(source.path) and not changes_place(place.path)
            # A quiet point this near to a focus is at the focus.
            # A source that moves past a quiet place is not quiet there from this distance on: far within half a
            # wavelength.
            within_mm = max(place.radius_mm, 0.01 if rests else 3.0)
            covered = np.hypot(*(own_mm - at_mm[number]).T) <= within_mm
            covered &= sounds & applies[index, number]
            if not covered.any():
                continue
            applies[index, number, covered] = False
            if covered[sounds].all() and place.source is None:
                raise InputError(
                    f"{place.words} at {show_mm(at_mm[number][0])} mm lies at the focus of source {index}; a quiet"
                    f" place must be further than {within_mm:g} mm from it"
                )
            begin_s = float(knots[np.argmax(covered)]) / rate_hz
            where = f"from {begin_s:.3g} s on, for {np.count_nonzero(covered) * SEGMENT_S:.2g} s in all"
            warnings.append(
                f"source {index} is at {place.words}{'' if covered[sounds].all() else f' {where}'}, and is not kept"
                " quiet there meanwhile"
            )
    return applies
