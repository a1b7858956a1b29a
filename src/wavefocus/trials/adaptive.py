"""Levels that follow the answers: transformed up-down staircases and QUEST+, several interleaved at random.

A track is a pure function of the answers given to it, so that a session resumes from the stored answers.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wavefocus.config.trials import AdaptiveTable
from wavefocus.trials.design import TrialsDesign
from wavefocus.trials.order import Trial, draws_of
from wavefocus.trials.psychometric import share_right

Float64Array = NDArray[np.float64]


def track_of(adaptive: AdaptiveTable, levels: Sequence[float]) -> Track:
    """Make a track over levels, in any order, all above 0, at its first trial."""
    ladder = sorted(levels, reverse=adaptive.harder == "lower")
    return UpDown(adaptive, ladder) if adaptive.method == "up_down" else QuestPlus(adaptive, ladder)


class UpDown:
    """A transformed up-down staircase (Levitt, J. Acoust. Soc. Am. 49 (1971) 467) over a ladder, easiest level first.

    After `right` right answers in a row at one level it takes the next harder one, after `wrong` wrong ones the next
    easier one, and begins at the easiest. A change of direction is a reversal. With one wrong answer it settles where
    p ** right = 0.5: 71 % for two right answers, 79 % for three.
    """

    def __init__(self, adaptive: AdaptiveTable, ladder: Sequence[float]) -> None:
        self._rules, self._ladder = adaptive, ladder
        self._at, self._rights, self._wrongs, self._trials = 0, 0, 0, 0
        self._direction = 0
        self.reversals: list[float] = []
        """Levels at which the direction changed."""

    def next_level(self) -> float | None:
        """The level to be answered now, one of the ladder; None where the track has ended."""
        ended = self._trials >= self._rules.trials or len(self.reversals) >= self._rules.reversals
        return None if ended else self._ladder[self._at]

    def answered(self, correct: bool) -> None:
        """Take whether the answer to that level was right."""
        self._trials += 1
        self._rights, self._wrongs = (self._rights + 1, 0) if correct else (0, self._wrongs + 1)
        if self._rights == self._rules.right:
            self._move(1)
        elif self._wrongs == self._rules.wrong:
            self._move(-1)

    @property
    def threshold(self) -> float | None:
        """Mean log10 of the levels at the reversals, without the first two or three, so that their number is even."""
        counted = self.reversals[2 + len(self.reversals) % 2 :]
        return float(np.log10(counted).mean()) if counted else None

    def _move(self, direction: int) -> None:
        if direction == -self._direction:
            self.reversals.append(self._ladder[self._at])
        self._direction, self._rights, self._wrongs = direction, 0, 0
        self._at = min(max(self._at + direction, 0), len(self._ladder) - 1)


THRESHOLDS, SLOPES = 61, 25
STEEPEST_PER_DECADE = 100.0
FLATTEST_PER_DECADE = 1.0


class QuestPlus:
    """QUEST+ (Watson, Journal of Vision 17(3):10, 2017) over a ladder, easiest level first.

    The posterior of threshold and slope stands on a grid, equal at first: thresholds over the ladder and a quarter of
    its length on either side, evenly in log10 of the level; slopes of 1 to 100 per decade, evenly in their logarithm;
    guess and lapse rate are given. Each level is the one after which the posterior's expected entropy is least; of
    several the easiest.
    """

    def __init__(self, adaptive: AdaptiveTable, ladder: Sequence[float]) -> None:
        x = np.log10(ladder)
        around = (x.max() - x.min()) / 4
        self._ladder, self._left = ladder, adaptive.trials
        slopes = np.geomspace(FLATTEST_PER_DECADE, STEEPEST_PER_DECADE, SLOPES)
        threshold, slope = np.meshgrid(
            np.linspace(x.min() - around, x.max() + around, THRESHOLDS),
            slopes if adaptive.harder == "lower" else -slopes,
            indexing="ij",
        )
        self._threshold, self._slope = threshold.ravel(), slope.ravel()
        self._right = share_right(x[:, None], self._threshold, self._slope, adaptive.guess_rate, adaptive.lapse_rate)
        """Share of right answers by level and grid point."""
        self._posterior = np.full(len(self._threshold), 1.0 / len(self._threshold))
        self._at = self._best()

    def next_level(self) -> float | None:
        return self._ladder[self._at] if self._left else None

    def answered(self, correct: bool) -> None:
        share = self._right[self._at]
        self._posterior = self._posterior * (share if correct else 1.0 - share)
        self._posterior /= self._posterior.sum()
        self._at, self._left = self._best(), self._left - 1

    @property
    def threshold(self) -> float:
        """Mean of the posterior."""
        return float(self._posterior @ self._threshold)

    @property
    def slope(self) -> float:
        """Geometric mean of the posterior, per decade."""
        return float(np.sign(self._slope[0]) * np.exp(self._posterior @ np.log(np.abs(self._slope))))

    def _best(self) -> int:
        """Index of the level of least expected entropy (Watson's eqs. 5 to 9)."""
        expected = np.zeros(len(self._ladder))
        for share in (self._right, 1.0 - self._right):
            joint = self._posterior * share
            # Entropy of the posterior after this answer, times the answer's probability.
            expected += _x_log_x(joint.sum(axis=1)) - _x_log_x(joint).sum(axis=1)
        # To 1e-12: the same choice on machines whose logarithms differ in the last bit.
        return int(np.argmin(np.round(expected, 12)))


def _x_log_x(x: Float64Array) -> Float64Array:
    return np.asarray(x * np.log(np.where(x > 0, x, 1.0)))


Track = UpDown | QuestPlus
"""One adaptive sequence of levels."""


class AdaptiveOrder:
    """Tracks in random turn; in a track, the level of the factor `correct` is drawn anew for each trial."""

    def __init__(self, design: TrialsDesign, participant: str) -> None:
        adaptive, trials = design.config.adaptive, design.config.trials
        assert adaptive is not None
        assert trials.correct is not None
        self._draws, self._most_alike = draws_of(design, participant), trials.most_alike
        self._stimuli = design.stimuli
        self._tracks: dict[str, Track] = {}
        self._named: dict[str, dict[float, dict[str, str]]] = {}
        for track in design.tracks:
            named = self._named[track] = {}
            for stimulus in design.stimuli.values():
                if stimulus.track == track:
                    side = "" if trials.correct == adaptive.factor else stimulus.level(trials.correct)
                    named.setdefault(getattr(stimulus, adaptive.factor), {})[side] = stimulus.name
            self._tracks[track] = track_of(adaptive, list(named))
        self._last, self._run, self._number = "", 0, 0
        self._trial = self._drawn()

    def next_trial(self) -> Trial | None:
        return self._trial

    def answered(self, answer: str) -> None:
        assert self._trial is not None
        self._tracks[self._trial.track].answered(answer == self._stimuli[self._trial.stimulus].correct)
        self._trial = self._drawn()

    def _drawn(self) -> Trial | None:
        running = [name for name, track in self._tracks.items() if track.next_level() is not None]
        if not running:
            return None
        track = running[self._draws.below(len(running))]
        level = self._tracks[track].next_level()
        assert level is not None
        sides = self._named[track][level]
        allowed = [side for side in sides if side != self._last or self._run < (self._most_alike or np.inf)]
        side = (allowed or list(sides))[self._draws.below(len(allowed or sides))]
        self._run = self._run + 1 if side == self._last else 1
        self._last, self._number = side, self._number + 1
        return Trial(self._number, 1, sides[side], track)
