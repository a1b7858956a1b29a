"""The course of a source that is ordered while it sounds: knots that are final, and a tail that is predicted.

A source goes straight from one ordered position to the next. Beyond the last one it goes on at the velocity of the last
`VELOCITY_S`, for at most the time of holding; where the measured surface ends, it stays at the last place on it. Then
it fades. All of this is knots: a tail that comes true is part of the record as it is.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rendering.arrays import Float64Array
from rendering.live.surface import Surface
from rendering.scene.signals import Signal
from rendering.scene.trajectory import Trajectory

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
    """Times of courses in samples: a fade, holding without a position, and those over which velocity is taken."""

    fade: int
    hold: int
    velocity: int
    jump_mm_per_sample: float


class Life:
    """A source from its appearance to its end; it sounds from the first knot to the last, where its amplitude is 0.

    begin: Sample of the first position. at_mm, amplitude: Place, on the surface, and amplitude there.
    before: A life that this one goes on from, at the same velocity.
    """

    ended: bool = False

    def __init__(
        self,
        name: str,
        signal: Signal,
        values: Float64Array,
        *,
        repeat: bool,
        surface: Surface,
        timing: Timing,
        begin: int,
        at_mm: tuple[float, float],
        amplitude: float,
        before: Life | None = None,
    ) -> None:
        self.name, self.signal, self.values, self.repeat = name, signal, values, repeat
        self.begin = begin
        self._surface, self._timing = surface, timing
        self._positions: deque[Knot] = deque() if before is None else before._positions
        self._amplitude = amplitude
        self._knots = [Knot(begin, *at_mm, 0.0)]
        self._taken = 0
        self._tail: list[Knot] = []
        self._course: Trajectory | None = None
        self._note_position(self._knots[0])
        self._predict()

    @property
    def end(self) -> int:
        """Sample of the last knot, as far as is known now."""
        return (self._tail or self._knots)[-1].sample

    def moved(self, sample: int, at_mm: tuple[float, float], amplitude: float) -> bool:
        """Take a position on the surface, at a sample not before the last one.

        Returns False where it is a jump: too far and too fast, or across places that cannot be rendered from. Then
        nothing is changed.
        """
        last = self._knots[-1]
        if sample <= last.sample:
            # Several positions within one block: the last one counts.
            if len(self._knots) > 1 and not self._reaches(self._knots[-2], Knot(last.sample, *at_mm, amplitude)):
                return False
            self._positions.pop()
            self._knots[-1] = Knot(last.sample, *at_mm, amplitude * self._risen(last.sample))
        else:
            if not self._reaches(last, Knot(sample, *at_mm, amplitude)):
                return False
            straight = trajectory([last._replace(amplitude=self._amplitude), Knot(sample, *at_mm, amplitude)])
            self._append(straight, [sample])
        self._amplitude = amplitude
        self._note_position(self._knots[-1])
        self._predict()
        return True

    def settle(self, sample: int) -> None:
        """Make the tail final where positions can no longer come in time, the next one being at `sample`."""
        if not self.ended and sample > self._knots[-1].sample + self._timing.hold:
            self._knots += self._tail
            self._tail, self.ended = [], True

    def finish(self, sample: int) -> None:
        """Fade from a sample on, not before the last position."""
        if self.ended:
            return
        course = trajectory([self._knots[-1]._replace(amplitude=self._amplitude), *self._tail])
        turns = [knot.sample for knot in self._tail if knot.sample < sample]
        if sample > self._knots[-1].sample:
            self._append(course, [*turns, sample])
        self._knots.append(self._knots[-1]._replace(sample=self._knots[-1].sample + self._timing.fade, amplitude=0.0))
        self._tail, self.ended, self._course = [], True, None

    @property
    def course(self) -> Trajectory:
        """All knots that are not forgotten, and the tail."""
        if self._course is None:
            self._course = trajectory(self._knots + self._tail)
        return self._course

    def take(self, sample: int) -> list[Knot]:
        """Final knots that were not taken yet; those before `sample` are final."""
        final = len(self._knots) if self.ended else sum(knot.sample < sample for knot in self._knots)
        taken = self._knots[self._taken : final]
        self._taken = max(self._taken, final)
        return taken

    def forget(self, sample: int) -> None:
        """Drop taken knots that say nothing of `sample` and later."""
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

    def _reaches(self, begin: Knot, end: Knot) -> bool:
        way_mm, samples = float(np.hypot(end.x_mm - begin.x_mm, end.y_mm - begin.y_mm)), end.sample - begin.sample
        if way_mm > JUMP_MM and way_mm > self._timing.jump_mm_per_sample * samples:
            return False
        places_mm, _ = trajectory([begin, end]).at(np.arange(begin.sample, end.sample + 1))
        return self._surface.reach(places_mm) == len(places_mm)

    def _append(self, course: Trajectory, samples: list[int]) -> None:
        """Make knots of a course final at samples after the last one, and where the source has appeared in full."""
        self._knots += self._with_rise(course, samples)

    def _with_rise(self, course: Trajectory, samples: list[int]) -> list[Knot]:
        risen = self.begin + self._timing.fade
        if self._knots[-1].sample < risen < samples[-1]:
            samples = sorted({*samples, risen})
        places_mm, amplitudes = course.at(np.array(samples))
        return [
            Knot(sample, place_mm[0], place_mm[1], amplitude * self._risen(sample))
            for sample, place_mm, amplitude in zip(samples, places_mm.tolist(), amplitudes.tolist(), strict=True)
        ]

    def _risen(self, sample: int) -> float:
        return min((sample - self.begin) / self._timing.fade, 1.0)

    def _note_position(self, position: Knot) -> None:
        self._positions.append(position)
        # One position before the time of velocity is kept where no other is within it.
        while len(self._positions) > 2 and self._positions[0].sample < position.sample - self._timing.velocity:
            self._positions.popleft()
        self._course = None

    def _velocity(self) -> tuple[float, float]:
        """Millimetres per sample along x and y, by least squares."""
        sample, x_mm, y_mm, _ = np.array(self._positions).T
        if sample[-1] == sample[0] or sample[-1] - sample[0] > self._timing.hold:
            return 0.0, 0.0
        offset = sample - sample.mean()
        return float(offset @ (x_mm - x_mm[-1]) / (offset @ offset)), float(
            offset @ (y_mm - y_mm[-1]) / (offset @ offset)
        )

    def _predict(self) -> None:
        last, hold = self._knots[-1]._replace(amplitude=self._amplitude), self._timing.hold
        right, up = self._velocity()
        held = last.sample + hold
        ahead = trajectory([last, Knot(held, last.x_mm + right * hold, last.y_mm + up * hold, self._amplitude)])
        count = hold + 1
        if right or up:
            samples = np.arange(last.sample, held + 1)
            count = max(self._surface.reach(ahead.at(samples)[0]), 1)
        stop = last.sample + count - 1
        (stop_mm,), _ = ahead.at(np.array([stop]))
        rests = [
            Knot(one, float(stop_mm[0]), float(stop_mm[1]), self._amplitude)
            for one in sorted({stop, held})
            if one > last.sample
        ]
        self._tail = self._with_rise(trajectory([last, *rests]), [knot.sample for knot in rests])
        self._tail.append(self._tail[-1]._replace(sample=held + self._timing.fade, amplitude=0.0))
        self._course = None
