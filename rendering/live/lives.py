"""The course of a source that is ordered while it sounds: knots that are final, and a tail that is predicted.

A source goes straight from one ordered position to the next. Beyond the last one it goes on at the velocity of the last
`VELOCITY_S`, for at most the time of holding; where the measured surface ends, it stays at the last place on it. Then
it fades. All of this is knots: a tail that comes true is part of the record as it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.base import Nodes, OffGridError
from wavefocus.rendering.live.emitted import Emitted
from wavefocus.rendering.live.surface import PlayableSurface
from wavefocus.rendering.scene.trajectory import Trajectory

VELOCITY_S = 0.03
"""Time over which the velocity is taken: two positions of a 60 Hz screen, for the jitter of one."""
JUMP_MM_S = 2000.0
"""No finger that stays on a surface is as fast."""
JUMP_MM = 5.0
"""Smaller steps, such as of a pointer in a small window, are no jumps at any speed."""
LOOK_S = 0.0025
"""A course is looked at so often; closer where the rows change."""


class Knot(NamedTuple):
    """A point of a trajectory."""

    sample: int
    x_mm: float
    y_mm: float
    amplitude: float


def trajectory(knots: list[Knot]) -> Trajectory:
    """The trajectory through knots."""
    table = np.array([knot[1:] for knot in knots])
    return Trajectory(np.array([knot.sample for knot in knots], dtype=np.int64), table[:, :2], table[:, 2])


class Run(NamedTuple):
    """Samples `begin` to `end` - 1 of a course, whose Green's functions are made of the same rows.

    weights, float64 (k, n) or (k, 1): Of each of the k rows, at each sample or at all of them.
    nearest: The row whose regularisation counts.
    """

    begin: int
    end: int
    rows: tuple[int, ...]
    weights: Float64Array
    nearest: int

    def between(self, first: int, stop: int) -> Run:
        """The samples of it from `first` to `stop` - 1."""
        begin, end = max(self.begin, first), min(self.end, stop)
        if (begin, end) == self[:2]:
            return self
        weights = self.weights if self.weights.shape[1] == 1 else self.weights[:, begin - self.begin : end - self.begin]
        return Run(begin, end, self.rows, weights, self.nearest)

    def goes_on(self, other: Run) -> bool:
        """Whether another run is the same one, a moment later."""
        same = (self.rows, self.nearest) == (other.rows, other.nearest)
        steady = self.weights.shape[1] == other.weights.shape[1] == 1
        return same and steady and bool((self.weights == other.weights).all())


@dataclass(frozen=True, slots=True)
class Timing:
    """Times in samples: of a fade, of holding without a position, over which velocity is taken; the speed of jumps.

    look: Between two looks at a course.
    """

    look: int
    fade: int
    hold: int
    velocity: int
    jump_mm_per_sample: float


class Life:
    """A source from its appearance to its end; it sounds from the first knot to the last, where its amplitude is 0.

    begin, at_mm, amplitude: Its first position, one that it can be rendered from: sample, place, amplitude.
    before: A life that it goes on from, at the same velocity.
    """

    course: Trajectory
    """All knots that are not forgotten, and the tail."""
    ended: bool = False
    _tail: list[Knot]

    def __init__(
        self,
        name: str,
        emitted: Emitted,
        surface: PlayableSurface,
        timing: Timing,
        *,
        begin: int,
        at_mm: tuple[float, float],
        amplitude: float,
        before: Life | None = None,
    ) -> None:
        self.name, self.emitted, self.begin = name, emitted, begin
        self._surface, self._timing = surface, timing
        self._positions: list[Knot] = [] if before is None else before._positions
        self._knots: list[Knot] = []
        self._taken, self._needed = 0, begin
        self._runs: list[Run] = []
        self._accept([], [Knot(begin, *at_mm, amplitude)], begin)

    @property
    def end(self) -> int:
        """Sample of the last knot, as far as it is certain now."""
        return int(self.course.sample[-1])

    def moved(self, sample: int, at_mm: tuple[float, float], amplitude: float) -> bool:
        """Take a position on the surface, at a sample not before the last one.

        Returns False where it is a jump: too far and too fast, or across places that cannot be rendered from. Then
        nothing is changed.
        """
        last, knots = self._positions[-1], self._knots
        position = Knot(sample, *at_mm, amplitude)
        points = [last, position]
        if sample <= last.sample:
            # Of several positions within one block the last one counts.
            knots, points = knots[:-1], [position._replace(sample=last.sample)]
        if knots:
            way_mm = math.hypot(position.x_mm - knots[-1].x_mm, position.y_mm - knots[-1].y_mm)
            if way_mm > max(JUMP_MM, self._timing.jump_mm_per_sample * (points[-1].sample - knots[-1].sample)):
                return False
        return self._accept(knots, points, knots[-1].sample + 1 if knots else self.begin)

    def settle(self, sample: int) -> None:
        """Make the tail final where positions can no longer come in time, the next one being at `sample`."""
        if not self.ended and sample > self._positions[-1].sample + self._timing.hold:
            self._knots, self._tail, self.ended = self._knots + self._tail, [], True

    def finish(self, sample: int) -> None:
        """Fade from a sample on, not before the last position, where the source then is."""
        if self.ended:
            return
        last = self._knots[-1]
        times = [knot.sample for knot in self._tail if knot.sample < sample] + [sample] * (sample > last.sample)
        places_mm, amplitudes = self.course.at(np.array(times, dtype=np.int64))
        knots = [*self._knots, *map(Knot, times, *places_mm.T.tolist(), amplitudes.tolist())]
        try:
            self._trace(self._faded(knots), last.sample + 1)
        except OffGridError:  # by rounding, along an edge
            knots = self._knots
            self._trace(self._faded(knots), last.sample + 1)
        self._knots, self._tail, self.ended = self._faded(knots), [], True

    def runs(self, first: int, stop: int) -> list[Run]:
        """What it passes at samples [first, stop)."""
        return [run.between(first, stop) for run in self._runs if run.begin < stop and run.end > first]

    def values(self, first: int, stop: int) -> Float64Array:
        """What it emits at samples [first, stop), all of them from `begin` to `end`, float64 (stop - first,)."""
        knots, amplitude = self.course.sample, self.course.amplitude
        # Mostly it neither appears nor fades.
        around = amplitude[max(np.searchsorted(knots, first, "right") - 1, 0) : np.searchsorted(knots, stop) + 1]
        loud = around[0] if (around == around[0]).all() else np.interp(np.arange(first, stop), knots, amplitude)
        return self.emitted.at(first - self.begin, stop - first) * loud

    def take(self, sample: int) -> list[Knot]:
        """Final knots that were not taken yet; those before `sample` are final."""
        final = len(self._knots) if self.ended else sum(knot.sample < sample for knot in self._knots)
        taken = self._knots[self._taken : final]
        self._taken = max(self._taken, final)
        return taken

    def forget(self, sample: int) -> None:
        """Drop taken knots that do not count at `sample` and later."""
        needless = 0
        while needless < self._taken - 1 and self._knots[needless + 1].sample <= sample:
            needless += 1
        del self._knots[:needless]
        self._taken -= needless
        self._needed = sample

    @property
    def taken(self) -> bool:
        """Whether it has ended and all of its knots were taken."""
        return self.ended and self._taken == len(self._knots)

    def _accept(self, before: list[Knot], points: list[Knot], changed: int) -> bool:
        """Go on from the knots before to the last of some points and on from there, staying on the surface.

        changed: First sample at which that may differ from the course so far.

        Returns False, and changes nothing, where the way to the point leaves the surface.
        """
        position = points[-1]
        positions = self._recent(position)
        right, up = _velocity(positions)
        knots = [*before, *self._appearing(points)[len(points) > 1 :]]
        held = position.sample + self._timing.hold
        stop = position.sample + self._surface.stays((position.x_mm, position.y_mm), (right, up), self._timing.hold)
        while True:
            ahead = stop - position.sample
            rest = Knot(stop, position.x_mm + right * ahead, position.y_mm + up * ahead, position.amplitude)
            tail = self._faded(self._appearing([position, *sorted({rest, rest._replace(sample=held)} - {position})]))[
                1:
            ]
            try:
                self._trace(knots + tail, changed)
                break
            except OffGridError as off:
                stop = changed + off.point - 1
                if stop < position.sample:
                    return False
        self._positions, self._knots, self._tail = positions, knots, tail
        return True

    def _appearing(self, points: list[Knot]) -> list[Knot]:
        """Knots of a way through some points that rise with the source's appearance."""
        risen = self.begin + self._timing.fade
        if points[0].sample >= risen:
            return points
        course, times = trajectory(points), [point.sample for point in points]
        if risen < times[-1]:
            times = sorted({*times, risen})
        places_mm, amplitudes = course.at(np.array(times))
        share = np.minimum((np.array(times) - self.begin) / self._timing.fade, 1.0)
        return list(map(Knot, times, *places_mm.T.tolist(), (amplitudes * share).tolist()))

    def _faded(self, knots: list[Knot]) -> list[Knot]:
        last = knots[-1]
        return [*knots, last._replace(sample=last.sample + self._timing.fade, amplitude=0.0)]

    def _recent(self, position: Knot) -> list[Knot]:
        """Positions by which the velocity is taken, the given one the last: those of `VELOCITY_S`, at least two."""
        earlier = [
            knot for knot in self._positions if position.sample - self._timing.hold <= knot.sample < position.sample
        ]
        within = [knot for knot in earlier if knot.sample >= position.sample - self._timing.velocity]
        return [*(within or earlier[-1:]), position]

    def _trace(self, knots: list[Knot], changed: int) -> None:
        """Evaluate a course from a sample on. Raises OffGridError, and changes nothing: a place is off the surface."""
        course = trajectory(knots)
        runs = self._traced(course, changed, knots[-1].sample)
        former = [
            run.between(self._needed, changed) for run in self._runs if run.end > self._needed and run.begin < changed
        ]
        if former and former[-1].goes_on(runs[0]):
            runs[0] = runs[0]._replace(begin=former.pop().begin)
        self.course, self._runs = course, former + runs

    def _traced(self, course: Trajectory, first: int, last: int) -> list[Run]:
        """Runs of a course from a sample to its last one.

        Where two looks see the same rows with the same weights, a straight way between them has no others: all places
        nearest to a row are a convex set, and elsewhere only the same place has the same weights.
        """
        look = np.arange(first, last + 1, self._timing.look)
        sample = np.sort(np.concatenate([look, course.sample[course.sample > first]]))
        nodes = self._nodes(course, sample, first)
        same = (nodes.rows[1:] == nodes.rows[:-1]) & (nodes.weights[1:] == nodes.weights[:-1])
        same = same.all(axis=1) & (nodes.nearest[1:] == nodes.nearest[:-1]) | (sample[1:] <= sample[:-1] + 1)
        if len(differ := np.flatnonzero(~same)):
            missing = np.concatenate([np.arange(sample[index] + 1, sample[index + 1]) for index in differ.tolist()])
            both = [nodes, self._nodes(course, missing, first)]
            order = np.argsort(np.concatenate([sample, missing]), kind="stable")
            sample = np.concatenate([sample, missing])[order]
            rows, weights, nearest = (
                np.concatenate([getattr(nodes, part) for nodes in both])[order]
                for part in ("rows", "weights", "nearest")
            )
            nodes = Nodes(rows, weights, nearest, np.zeros(0))
        return _runs(sample, nodes, last + 1)

    def _nodes(self, course: Trajectory, sample: Int64Array, first: int) -> Nodes:
        """Nodes at samples; the point of an OffGridError counts samples from `first`."""
        try:
            return self._surface.nodes(course.at(sample)[0])
        except OffGridError as off:
            point, message = off.point, str(off)
            if point and sample[point] > sample[point - 1] + 1:  # which of those between is the first?
                between = np.arange(sample[point - 1] + 1, sample[point] + 1)
                try:
                    self._surface.nodes(course.at(between)[0])
                except OffGridError as exact:
                    sample, point, message = between, exact.point, str(exact)
            raise OffGridError(int(sample[point]) - first, message) from None


def _runs(sample: Int64Array, nodes: Nodes, stop: int) -> list[Run]:
    """Runs of looks, each of which stands until the next one, the last one until `stop`."""
    changes = (nodes.rows[1:] != nodes.rows[:-1]).any(axis=1) | (nodes.nearest[1:] != nodes.nearest[:-1])
    first = np.concatenate([[0], np.flatnonzero(changes) + 1])
    begins, ends = first.tolist(), [*first[1:].tolist(), len(sample)]
    rows, nearest = nodes.rows[first].tolist(), nodes.nearest[first].tolist()
    at, runs = [*sample[first].tolist(), stop], []
    for number, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        weights = nodes.weights[begin:end]
        if weights.shape[1] > 1 and (weights != weights[0]).any():
            weights = np.repeat(weights, np.diff(sample[begin:end], append=at[number + 1]), axis=0)
        else:
            weights = weights[:1]
        runs.append(Run(at[number], at[number + 1], tuple(rows[number]), weights.T, nearest[number]))
    return runs


def _velocity(positions: list[Knot]) -> tuple[float, float]:
    """Millimetres per sample along x and y, by least squares; 0 of one position."""
    last, mean = positions[-1], sum(knot.sample for knot in positions) / len(positions)
    offsets = [knot.sample - mean for knot in positions]
    square = sum(offset * offset for offset in offsets)
    if not square:
        return 0.0, 0.0
    right = sum(offset * (knot.x_mm - last.x_mm) for offset, knot in zip(offsets, positions, strict=True))
    up = sum(offset * (knot.y_mm - last.y_mm) for offset, knot in zip(offsets, positions, strict=True))
    return right / square, up / square
