"""A source that is ordered while it sounds: its signal, and its course of final knots and a tail that is predicted.

A source goes straight from one ordered position to the next. Beyond the last one it goes on at the velocity of the last
`VELOCITY_S`, for at most the time of holding; where the measured surface ends, it stays at the last place on it. Then
it fades. All of this is knots: a tail that comes true is part of the record as it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.base import Nodes, OffGridError
from wavefocus.rendering.greens.source import GreenSource
from wavefocus.rendering.live.surface import PlayableSurface
from wavefocus.rendering.scene.signals import Noise, Signal, signal_size
from wavefocus.rendering.scene.trajectory import Trajectory
from wavefocus.storage.errors import InputError

MAX_SIGNAL_S = 60.0


@dataclass(frozen=True, slots=True)
class Emitted:
    """A signal that a source emits from its first sample on, at the bank's rate."""

    signal: Signal
    values: Float64Array
    repeat: bool

    def at(self, since: int, samples: int) -> Float64Array:
        """Values from so many samples after the first on, float64 (samples,)."""
        if self.repeat:
            return np.take(self.values, np.arange(since, since + samples), mode="wrap")
        values = self.values[since : since + samples]
        return np.pad(values, (0, samples - len(values)))


def emitted_by(signal: Signal, rate_hz: float, *, repeat: bool = True) -> Emitted:
    """What a live source emits of a signal.

    Raises InputError: the signal cannot be made at this rate, or is too long.
    """
    samples, _ = signal_size(signal, rate_hz)
    if not samples <= MAX_SIGNAL_S * rate_hz:
        raise InputError(
            f"a signal of {samples / rate_hz:.4g} s is too long; live sources take up to {MAX_SIGNAL_S:g} s"
        )
    return Emitted(signal, signal.samples(rate_hz), repeat)


def default_signal(bank: GreenSource) -> Signal:
    """Noise of the bank's band, 1 s; of 50 to 450 Hz, as far as the rate allows, where the band is not stated."""
    half_hz = float(bank.sample_rate_hz) / 2.0
    low_hz, high_hz = bank.band_hz or (min(50.0, half_hz / 4.0), min(450.0, half_hz))
    return Noise((low_hz, min(high_hz, half_hz)), 1.0)


VELOCITY_S = 0.03
"""Time over which the velocity is taken: two positions of a 60 Hz screen, for the jitter of one."""
JUMP_MM_S = 2000.0
"""No finger that stays on a surface is as fast."""
HOLD_S, FADE_S = 0.25, 0.01
"""For so long a source goes on at its last velocity without a position; duration of each fade."""
LOOK_S = 0.0025
"""A course is looked at so often; closer where the rows change."""


class _Knot(NamedTuple):
    """A point of a trajectory."""

    sample: int
    x_mm: float
    y_mm: float
    amplitude: float


def trajectory(knots: list[_Knot]) -> Trajectory:
    """The trajectory through knots."""
    table = np.array([knot[1:] for knot in knots])
    return Trajectory(np.array([knot.sample for knot in knots], dtype=np.int64), table[:, :2], table[:, 2])


class Run(NamedTuple):
    """Samples `begin` to `end` - 1 of a life, whose Green's functions are made of the same rows.

    life: Its number in the list.
    weights, float64 (k, n) or (k, 1): Of each of the k rows, at each sample or at all of them.
    nearest: The row whose regularisation counts.
    """

    life: int
    begin: int
    end: int
    rows: list[int]
    weights: Float64Array
    nearest: int


class Timing:
    """Times in samples: of a fade, of holding without a position, over which velocity is taken; the speed of jumps.

    look: Between two looks at a course.
    """

    def __init__(self, rate_hz: float) -> None:
        self.look, self.fade, self.hold = (max(1, round(time_s * rate_hz)) for time_s in (LOOK_S, FADE_S, HOLD_S))
        self.velocity, self.jump_mm_per_sample = round(VELOCITY_S * rate_hz), JUMP_MM_S / rate_hz


class Life:
    """A source from its appearance to its end; it sounds from the first knot to the last, where its amplitude is 0.

    begin, at_mm, amplitude: Its first position, one that it can be rendered from: sample, place, amplitude.
    before: A life that it goes on from, at the same velocity.
    """

    ended: bool = False
    rests: bool = False
    """The last position changed nothing but how long the source goes on."""
    _tail: list[_Knot]
    _velocity: tuple[float, float] = (0.0, 0.0)
    _course: Trajectory | None = None

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
        self.name, self.emitted, self.begin, self.look = name, emitted, begin, timing.look
        self._surface, self._timing = surface, timing
        self._positions: list[_Knot] = [] if before is None else before._positions
        self._knots: list[_Knot] = []
        self._taken = 0
        self._accept([], [_Knot(begin, *at_mm, amplitude)])

    @property
    def course(self) -> Trajectory:
        """All knots that are not forgotten, and the tail."""
        if self._course is None:
            self._course = trajectory(self._knots + self._tail)
        return self._course

    @property
    def end(self) -> int:
        """Sample of the last knot, as far as it is certain now."""
        return (self._tail or self._knots)[-1].sample

    def moved(self, sample: int, at_mm: tuple[float, float], amplitude: float) -> bool:
        """Take a position on the surface, at a sample not before the last one.

        Returns False where it is a jump: too far and too fast, or across places that cannot be rendered from. Then
        nothing is changed.
        """
        last, knots = self._positions[-1], self._knots
        position = _Knot(sample, *at_mm, amplitude)
        points = [last, position]
        if sample <= last.sample:
            # Of several positions within one block the last one counts.
            knots, points = knots[:-1], [position._replace(sample=last.sample)]
        if knots:
            way_mm = math.hypot(position.x_mm - knots[-1].x_mm, position.y_mm - knots[-1].y_mm)
            # Smaller steps, such as of a pointer in a small window, are no jumps at any speed.
            if way_mm > max(5.0, self._timing.jump_mm_per_sample * (points[-1].sample - knots[-1].sample)):
                return False
        return self._accept(knots, points)

    def settle(self, sample: int) -> None:
        """Make the tail final where positions can no longer come in time, the next one being at `sample`."""
        if not self.ended and sample > self._positions[-1].sample + self._timing.hold:
            stop = self._reaches(self._knots[-1:] + self._tail[:-1], 1)
            tail = self._tail if stop >= self._tail[-2 if len(self._tail) > 1 else -1].sample else self._ahead(stop)
            self._end(self._knots + tail)

    def finish(self, sample: int) -> None:
        """Fade from a sample on, not before the last position, where the source then is."""
        if self.ended:
            return
        last = self._knots[-1]
        times = [knot.sample for knot in self._tail if knot.sample < sample] + [sample] * (sample > last.sample)
        places_mm, amplitudes = self.course.at(np.array(times, dtype=np.int64))
        knots = [last, *map(_Knot, times, *places_mm.T.tolist(), amplitudes.tolist())]
        if self._reaches(knots, 1) < knots[-1].sample:  # by rounding, along an edge
            knots = [last]
        self._end(self._faded(self._knots[:-1] + knots))

    def values(self, first: int, stop: int) -> Float64Array:
        """What it emits at samples [first, stop), all of them from `begin` to `end`, float64 (stop - first,)."""
        knots, amplitude = self.course.sample, self.course.amplitude
        # Mostly it neither appears nor fades.
        around = amplitude[max(np.searchsorted(knots, first, "right") - 1, 0) : np.searchsorted(knots, stop) + 1]
        loud = around[0] if (around == around[0]).all() else np.interp(np.arange(first, stop), knots, amplitude)
        return self.emitted.at(first - self.begin, stop - first) * loud

    def take(self, sample: int) -> list[_Knot]:
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
        if needless:
            del self._knots[:needless]
            self._taken -= needless
            self._course = None

    @property
    def taken(self) -> bool:
        """Whether it has ended and all of its knots were taken."""
        return self.ended and self._taken == len(self._knots)

    def _accept(self, before: list[_Knot], points: list[_Knot]) -> bool:
        """Go on from the knots before to the last of some points and on from there, staying on the surface.

        Returns False, and changes nothing, where the way to the point leaves the surface.
        """
        position = points[-1]
        way = [*before[-1:], position]
        if self._reaches(way, 1) < position.sample:
            return False
        former, self._positions = self._positions[-1:], self._recent(position)
        velocity, self._velocity = self._velocity, _velocity(self._positions)
        self.rests = (
            [knot[1:] for knot in former] == [position[1:]]
            and velocity == self._velocity == (0.0, 0.0)
            and before[-1:] == former
        )
        self._knots = [*before, *self._appearing(points)[len(points) > 1 :]]
        place_mm, hold = (position.x_mm, position.y_mm), self._timing.hold
        stop = position.sample + self._surface.stays(place_mm, self._velocity, hold)
        self._tail = self._ahead(stop)
        if any(self._velocity):
            reached = self._reaches([position, *self._tail[:-1]], self._timing.look)
            if reached < stop:
                self._tail = self._ahead(reached)
        self._course = None
        return True

    def _ahead(self, stop: int) -> list[_Knot]:
        """The tail: on at the velocity until a sample, then at rest."""
        position, (right, up) = self._positions[-1], self._velocity
        ahead = stop - position.sample
        rest = _Knot(stop, position.x_mm + right * ahead, position.y_mm + up * ahead, position.amplitude)
        held = rest._replace(sample=position.sample + self._timing.hold)
        return self._faded(self._appearing([position, *sorted({rest, held} - {position})]))[1:]

    def _reaches(self, knots: list[_Knot], step: int) -> int:
        """The last of the knots' samples, or that of the last look, so many samples apart, before the surface ends."""
        first, last = knots[0].sample, knots[-1].sample
        if self._surface.holds(*[knot[1:3] for knot in knots]):
            return last
        sample = np.append(np.arange(first + step, last, step), last)
        times, x_mm, y_mm, _ = zip(*knots, strict=True)
        try:
            self._surface.nodes(np.stack([np.interp(sample, times, x_mm), np.interp(sample, times, y_mm)], axis=1))
        except OffGridError as off:
            return int(sample[off.point - 1]) if off.point else first if len(knots) > 1 else first - 1
        return last

    def _end(self, knots: list[_Knot]) -> None:
        self._knots, self._tail, self._course, self.ended = knots, [], None, True

    def _appearing(self, points: list[_Knot]) -> list[_Knot]:
        """Knots of a way through some points that rise with the source's appearance."""
        risen = self.begin + self._timing.fade
        if points[0].sample >= risen:
            return points
        course, times = trajectory(points), [point.sample for point in points]
        if risen < times[-1]:
            times = sorted({*times, risen})
        places_mm, amplitudes = course.at(np.array(times))
        share = np.minimum((np.array(times) - self.begin) / self._timing.fade, 1.0)
        return list(map(_Knot, times, *places_mm.T.tolist(), (amplitudes * share).tolist()))

    def _faded(self, knots: list[_Knot]) -> list[_Knot]:
        last = knots[-1]
        return [*knots, last._replace(sample=last.sample + self._timing.fade, amplitude=0.0)]

    def _recent(self, position: _Knot) -> list[_Knot]:
        """Positions by which the velocity is taken, the given one the last: those of `VELOCITY_S`, at least two."""
        earlier = [
            knot for knot in self._positions if position.sample - self._timing.hold <= knot.sample < position.sample
        ]
        within = [knot for knot in earlier if knot.sample >= position.sample - self._timing.velocity]
        return [*(within or earlier[-1:]), position]


def runs_of(lives: Sequence[Life], nodes_at: Callable[[Float64Array], Nodes], first: int, stop: int) -> list[Run]:
    """What lives pass at samples [first, stop), life by life, in the order of time.

    Where two looks see the same rows with the same weights, a straight way between them has no others: all places
    nearest to a row are a convex set, and elsewhere only the same place has the same weights.

    nodes_at: Rows and weights of places, float64 (n, 2) in millimetres.
    """
    courses = [life.course for life in lives]
    low = min(first, *(int(course.sample[0]) for course in courses))
    span = max(stop, *(int(course.sample[-1]) for course in courses)) - low + 1
    # One axis of time for all lives, one after the other.
    knots = np.concatenate([course.sample + (number * span - low) for number, course in enumerate(courses)])
    at_mm = np.concatenate([course.at_mm for course in courses])
    begins, ends = np.array([(course.sample[0], course.sample[-1]) for course in courses]).T

    def places(life: Int64Array, sample: Int64Array) -> Float64Array:
        time = np.minimum(np.maximum(sample, begins[life]), ends[life]) + (life * span - low)
        return np.stack([np.interp(time, knots, at_mm[:, 0]), np.interp(time, knots, at_mm[:, 1])], axis=1)

    bends = np.concatenate([course.sample for course in courses])
    look = lives[0].look
    sample = np.unique(
        np.concatenate([np.arange(first, stop, look), bends[(bends > first) & (bends < stop)], [stop - 1]])
    )
    gaps, number = np.diff(sample), np.repeat(np.arange(len(lives)), len(sample))
    time = np.tile(sample, len(lives))
    nodes = nodes_at(places(number, time))
    seen = [nodes.rows, nodes.weights, nodes.nearest]
    same = (nodes.rows[1:] == nodes.rows[:-1]) & (nodes.weights[1:] == nodes.weights[:-1])
    gap = np.tile(np.append(gaps, 1), len(lives))[:-1]
    differ = np.flatnonzero(~(same.all(axis=1) & (nodes.nearest[1:] == nodes.nearest[:-1])) & (gap > 1))
    if len(differ):
        between = gap[differ] - 1
        which = np.repeat(differ, between)
        offset = np.arange(1, len(which) + 1) - np.repeat(np.cumsum(between) - between, between)
        added = nodes_at(places(number[which], time[which] + offset))
        time, number = np.concatenate([time, time[which] + offset]), np.concatenate([number, number[which]])
        order = np.argsort(number * span + time, kind="stable")
        time, number = time[order], number[order]
        seen = [
            np.concatenate(both)[order] for both in zip(seen, (added.rows, added.weights, added.nearest), strict=True)
        ]
    rows, weights, nearest = seen
    changes = (rows[1:] != rows[:-1]).any(axis=1) | (nearest[1:] != nearest[:-1]) | (number[1:] != number[:-1])
    start = np.concatenate([[0], np.flatnonzero(changes) + 1])
    runs = []
    for begin, end, life, row, near in zip(
        start.tolist(), [*start[1:].tolist(), len(time)], number[start].tolist(), rows[start].tolist(),
        nearest[start].tolist(), strict=True,
    ):  # fmt: skip
        until = int(time[end]) if end < len(time) and number[end] == life else stop
        part = weights[begin:end]
        if part.shape[1] > 1 and (part != part[0]).any():
            part = np.repeat(part, np.diff(time[begin:end], append=until), axis=0)
        else:
            part = part[:1]
        runs.append(Run(life, int(time[begin]), until, row, np.asarray(part.T, dtype=np.float64), near))
    return runs


def _velocity(positions: list[_Knot]) -> tuple[float, float]:
    """Millimetres per sample along x and y, by least squares; 0 of one position."""
    last, mean = positions[-1], sum(knot.sample for knot in positions) / len(positions)
    offsets = [knot.sample - mean for knot in positions]
    square = sum(offset * offset for offset in offsets)
    if not square:
        return 0.0, 0.0
    right = sum(offset * (knot.x_mm - last.x_mm) for offset, knot in zip(offsets, positions, strict=True))
    up = sum(offset * (knot.y_mm - last.y_mm) for offset, knot in zip(offsets, positions, strict=True))
    return right / square, up / square
