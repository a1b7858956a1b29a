"""The course of a source that is ordered while it sounds: knots that are final, and a tail that is predicted.

A source goes straight from one ordered position to the next. Beyond the last one it goes on at the velocity of the last
`VELOCITY_S`, for at most the time of holding; where the measured surface ends, it stays at the last place on it. Then
it fades. All of this is knots: a tail that comes true is part of the record as it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from wavefocus.rendering.drive.windows import Events
from wavefocus.rendering.greens.interpolation.base import OffGridError
from wavefocus.rendering.live.emitted import Emitted
from wavefocus.rendering.live.surface import Surface
from wavefocus.rendering.scene.trajectory import Trajectory

VELOCITY_S = 0.03
"""Time over which the velocity is taken: two positions of a 60 Hz screen, for the jitter of one."""
JUMP_MM_S = 2000.0
"""No finger that stays on a surface is as fast."""
JUMP_MM = 5.0
"""Smaller steps, such as of a pointer in a small window, are no jumps at any speed."""


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


@dataclass(frozen=True, slots=True)
class Timing:
    """Times in samples: of a fade, of holding without a position, over which velocity is taken; the speed of jumps."""

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
        surface: Surface,
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
        self._taken, self._needed, self._first = 0, begin, begin
        self._events: Events | None = None
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

    def events(self, first: int, stop: int) -> Events | None:
        """What it emits at samples [first, stop), counted from `first`; None where that is nothing."""
        begin, end = max(first, self._first), min(stop, self.end + 1)
        if begin >= end or self._events is None:
            return None
        return _part(self._events, begin - self._first, end - self._first, first)

    def take(self, sample: int) -> list[Knot]:
        """Final knots that were not taken yet; those before `sample` are final."""
        final = len(self._knots) if self.ended else sum(knot.sample < sample for knot in self._knots)
        taken = self._knots[self._taken : final]
        self._taken = max(self._taken, final)
        return taken

    def forget(self, sample: int) -> None:
        """Drop what says nothing of `sample` and later, taken knots alone."""
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
            one for one in self._positions if position.sample - self._timing.hold <= one.sample < position.sample
        ]
        within = [one for one in earlier if one.sample >= position.sample - self._timing.velocity]
        return [*(within or earlier[-1:]), position]

    def _trace(self, knots: list[Knot], changed: int) -> None:
        """Evaluate a course from a sample on. Raises OffGridError, and changes nothing: a place is off the surface."""
        course = trajectory(knots)
        sample = np.arange(changed, knots[-1].sample + 1)
        places_mm, amplitude = course.at(sample)
        values = self.emitted.at(sample - self.begin) * amplitude
        # Where it rests one look is enough.
        moves = [after.sample for before, after in pairwise(knots) if before[1:3] != after[1:3]]
        moving = max([changed, *moves]) - changed + 1
        nodes = self._surface.nodes(places_mm[:moving])
        place = np.minimum(np.arange(len(sample)), moving - 1)
        rows, weights = nodes.rows.take(place, axis=0), nodes.weights.take(place, axis=0)
        events, first = Events(rows, weights, nodes.nearest.take(place), sample, values), changed
        if self._events is not None and (begin := max(self._needed, self._first)) < changed:
            former = _part(self._events, begin - self._first, changed - self._first, 0)
            events, first = joined([former, events]), begin
        self.course, self._events, self._first = course, events, first


def joined(parts: list[Events]) -> Events:
    """Events one after the other."""
    return Events(
        np.concatenate([part.rows for part in parts]), np.concatenate([part.weights for part in parts]),
        np.concatenate([part.regularised_by for part in parts]), np.concatenate([part.sample for part in parts]),
        np.concatenate([part.values for part in parts]),
    )  # fmt: skip


def _part(events: Events, begin: int, end: int, first: int) -> Events:
    """Events begin to end - 1, counted from sample `first`."""
    part = slice(begin, end)
    return Events(
        events.rows[part], events.weights[part], events.regularised_by[part], events.sample[part] - first,
        events.values[part],
    )  # fmt: skip


def _velocity(positions: list[Knot]) -> tuple[float, float]:
    """Millimetres per sample along x and y, by least squares; 0 of one position."""
    last, mean = positions[-1], sum(one.sample for one in positions) / len(positions)
    offsets = [one.sample - mean for one in positions]
    square = sum(offset * offset for offset in offsets)
    if not square:
        return 0.0, 0.0
    right = sum(offset * (one.x_mm - last.x_mm) for offset, one in zip(offsets, positions, strict=True))
    up = sum(offset * (one.y_mm - last.y_mm) for offset, one in zip(offsets, positions, strict=True))
    return right / square, up / square
