"""The order of a participant's trials: seeded, balanced over blocks, and never too many alike in a row.

It follows only from the trials file and the participant's code, and from the answers where levels follow these; so a
session that is resumed goes on in the same order.
"""

import hashlib
import random
from bisect import bisect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Protocol

from wavefocus.trials.design import TrialsDesign


@dataclass(frozen=True, slots=True)
class Trial:
    """One trial: its number and that of its block, both from 1, its stimulus, and its adaptive track or ``""``."""

    number: int
    block: int
    stimulus: str
    track: str = ""


class Order(Protocol):
    """Trials of a participant, one after another."""

    def next_trial(self) -> Trial | None:
        """The trial to be answered now, the same until it is; None where all are."""

    def answered(self, answer: str) -> None:
        """Take the answer to that trial."""


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


def draws_of(design: TrialsDesign, participant: str) -> Draws:
    """The draws of a participant's order."""
    return Draws(f"{design.config.trials.seed} {participant}")


class FixedOrder:
    """Every stimulus equally often in each block."""

    def __init__(self, design: TrialsDesign, participant: str) -> None:
        trials = design.config.trials
        each = trials.repetitions // trials.blocks
        names = ordered(
            list(design.stimuli), lambda name: design.stimuli[name].level(design.alike), draws_of(design, participant),
            each=each, blocks=trials.blocks, most_alike=trials.most_alike,
        )  # fmt: skip
        in_block = each * len(design.stimuli)
        self.trials = tuple(Trial(1 + k, 1 + k // in_block, name) for k, name in enumerate(names))
        self._done = 0

    def next_trial(self) -> Trial | None:
        return self.trials[self._done] if self._done < len(self.trials) else None

    def answered(self, answer: str) -> None:
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
