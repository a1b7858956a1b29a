"""The order of a participant's trials, and where it goes on after the answers that are stored.

Fixed orders are seeded, balanced over blocks, and never have too many alike in a row; levels may follow the answers,
by transformed up-down staircases and QUEST+, several interleaved at random. An order follows only from the trials
file, the participant's code and the answers, so that a session that is resumed goes on in the same one.
"""

from __future__ import annotations

import hashlib
import random
from bisect import bisect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from wavefocus.config.trials import AdaptiveTable
from wavefocus.rendering.arrays import Float64Array
from wavefocus.storage.errors import InputError
from wavefocus.trials.answers import Row
from wavefocus.trials.design import TrialsDesign

if TYPE_CHECKING:
    from wavefocus.trials.stimuli import Prepared


def share_right(
    level: ArrayLike, threshold: ArrayLike, slope: ArrayLike, guess: ArrayLike, lapse: ArrayLike
) -> Float64Array:
    """Share of right answers: a logistic function, p = guess + (1 - guess - lapse) / (1 + exp(-slope (x - threshold))).

    level: x, the common logarithm of the stimulus's level.
    threshold: The x at which p lies midway between guess and 1 - lapse.
    slope: Per unit of x, so per decade of the level; negative where higher levels are harder.
    guess, lapse: Share of right answers without a stimulus, and of slips with any.

    All broadcast. Source: Wichmann and Hill, Percept. Psychophys. 63 (2001), 1293, equation 1.
    """
    x, midway, steepness, low, slips = (
        np.asarray(value, np.float64) for value in (level, threshold, slope, guess, lapse)
    )
    # The hyperbolic tangent does not overflow.
    shares: Float64Array = low + (1.0 - low - slips) * 0.5 * (1.0 + np.tanh(0.5 * steepness * (x - midway)))
    return shares


@dataclass(frozen=True, slots=True)
class Trial:
    """One trial: its number and that of its block, both from 1, its stimulus, and its adaptive track or ``""``."""

    number: int
    block: int
    stimulus: str
    track: str = ""


class Draws:
    """Draws that follow from a text, the same for every version of Python.

    Python keeps the numbers of ``random.Random.random`` for a seed, a whole number, in all of its versions; of its
    other methods it does not (documentation of the module random, "Notes on Reproducibility").
    """

    def __init__(self, text: str) -> None:
        self._random = random.Random(int.from_bytes(hashlib.sha256(text.encode()).digest()))

    def below(self, count: int) -> int:
        """A whole number from 0 to count - 1, all alike."""
        return int(self._random.random() * count)

    def weighted(self, weights: Sequence[int]) -> int:
        """Index of one of the weights, as likely as it is large; one is above 0."""
        sums = list(accumulate(weights))
        return bisect(sums, self.below(sums[-1]))


class FixedOrder:
    """Every stimulus equally often in each block."""

    def __init__(self, design: TrialsDesign, participant: str) -> None:
        trials = design.config.trials
        each, draws = trials.repetitions // trials.blocks, Draws(f"{trials.seed} {participant}")
        names = ordered(
            list(design.stimuli), lambda name: design.stimuli[name].level(design.alike), draws,
            each=each, blocks=trials.blocks, most_alike=trials.most_alike,
        )  # fmt: skip
        in_block = each * len(design.stimuli)
        self.trials = tuple(Trial(1 + k, 1 + k // in_block, name) for k, name in enumerate(names))
        self._done = 0

    def next_trial(self) -> Trial | None:
        """The trial to be answered now, the same until it is; None where all are."""
        return self.trials[self._done] if self._done < len(self.trials) else None

    def answered(self, answer: str) -> None:
        """Take the answer to that trial."""
        self._done += 1


def ordered(
    stimuli: Sequence[str],
    level_of: Callable[[str], str],
    draws: Draws,
    *,
    each: int,
    blocks: int,
    most_alike: int,
) -> list[str]:
    """Names of stimuli, each `each` times in every block, at most `most_alike` (0: any number) of a level in a row.

    Each trial is drawn from those left in the block, all alike; a draw after which the block could not be completed is
    drawn again. With c trials left of a level and r of all others, at most m in a row, it can be where c <= m (r + 1)
    for every level, and c <= m - k + m r for one that stands k times in a row already: the others part it into r + 1
    rows. Of two levels never both break this, and none does where the design's check passed; so there always is a draw.
    """
    of_level: dict[str, list[str]] = {}
    for name in stimuli:
        of_level.setdefault(level_of(name), []).append(name)
    most = most_alike or each * len(stimuli) * blocks
    order: list[str] = []
    last, run = -1, 0
    for _ in range(blocks):
        left = [names * each for names in of_level.values()]
        for after in reversed(range(each * len(stimuli))):
            weights = [len(names) for names in left]
            tight = [c for c, count in enumerate(weights) if count * (most + 1) > most * (after + 1)]
            while True:
                level = draws.weighted(weights)
                row = run + 1 if level == last else 1
                count = len(left[level]) - 1
                if row <= most and tight in ([], [level]) and count <= most - row + most * (after - count):
                    break
                weights[level] = 0
            last, run = level, row
            order.append(left[level].pop(draws.below(count + 1)))
    return order


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


class _AdaptiveOrder:
    """Tracks in random turn; in a track, the level of the factor `correct` is drawn anew for each trial."""

    def __init__(self, design: TrialsDesign, participant: str) -> None:
        adaptive, trials = design.config.adaptive, design.config.trials
        assert adaptive is not None
        assert trials.correct is not None
        self._draws, self._most_alike = Draws(f"{trials.seed} {participant}"), trials.most_alike
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


Order = FixedOrder | _AdaptiveOrder
"""Trials of a participant, one after another."""


def order_of(design: TrialsDesign, participant: str) -> Order:
    """Make the order of a participant, at its first trial; give it the answers that are stored to go on."""
    if design.config.adaptive is None:
        return FixedOrder(design, participant)
    return _AdaptiveOrder(design, participant)


def resume_sequence(
    design: TrialsDesign, participant: str, rows: Sequence[Row], prepared: Prepared | None = None
) -> tuple[Order, int]:
    """Make the order of a participant, at the trial after those that are answered, and count these.

    rows: Answers of all participants.
    prepared: The stimuli; until they are prepared, answers are held against the trials file alone.

    Raises InputError: the participant is complete, has a code that differs from another's only in case,
    or has answered trials of another trials file, bank or order.
    """
    order, done = order_of(design, participant), 0
    bank_sha256 = None if prepared is None else prepared.bank_sha256
    stimulus_sha256 = {} if prepared is None else prepared.sha256
    for row in rows:
        if row.participant != participant:
            if row.participant.casefold() == participant.casefold():
                raise InputError(f"participant is {participant}, and {row.participant} has answers: use another code")
            continue
        trial = order.next_trial()
        where = f"participant {participant} answered trial {row.trial}"
        for what, then, now in (
            (f"{design.file}, the trials file,", row.trials_sha256, design.sha256),
            ("the bank", row.bank_sha256, bank_sha256),
            (f"the stimulus {row.stimulus}", row.stimulus_sha256, stimulus_sha256.get(row.stimulus)),
        ):
            if now is not None and then != now:
                raise InputError(
                    f"{where} before {what} was changed: put it back, or begin with another code or folder"
                )
        if trial is None or (trial.number, trial.stimulus) != (row.trial, row.stimulus):
            expected = "none" if trial is None else f"trial {trial.number}, {trial.stimulus}"
            raise InputError(
                f"{where}, {row.stimulus}, where the order has {expected}: the answers were changed, or stored by"
                " another version; begin with another code"
            )
        order.answered(row.answer)
        done += 1
    if order.next_trial() is None:
        raise InputError(f"participant {participant} is complete: {done} trials are answered; use another code")
    return order, done
