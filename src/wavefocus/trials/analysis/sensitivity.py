"""Sensitivity d' and criterion of answers of two kinds, by the theory of signal detection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.trials.analysis.shares import all_and_each, factors_of, groups

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """Sensitivity of one group of trials.

    participant, factors: See `wavefocus.trials.analysis.shares.Share`.
    signal, noise: The answers that are right in the two kinds of trials.
    hits, of_signal: Answers `signal` in trials where that is right, and all those trials.
    false_alarms, of_noise: Answers `signal` in trials where `noise` is right, and all those trials.
    criterion: Positive where `noise` is preferred.
    """

    participant: str
    factors: Mapping[str, str]
    signal: str
    noise: str
    hits: int
    of_signal: int
    false_alarms: int
    of_noise: int
    d_prime: float
    interval: tuple[float, float]
    criterion: float


def d_prime(hits: int, of_signal: int, false_alarms: int, of_noise: int) -> tuple[float, tuple[float, float], float]:
    """Sensitivity d' = z(H) - z(F), its 95 % interval, and criterion c = -(z(H) + z(F)) / 2 of one interval.

    H = (hits + 1/2) / (of_signal + 1), F alike: log-linear correction (Hautus, Behav. Res. Methods 27 (1995), 46).
    Interval: d' +- 1.96 of the root of H (1 - H) / (n phi(z(H))^2), summed with the same of F (Gourevitch and Galanter,
    Psychometrika 32 (1967), 25), with n the number of trials and phi the normal density.
    """
    from scipy.stats import norm

    total = np.array([of_signal, of_noise])
    rate = (np.array([hits, false_alarms]) + 0.5) / (total + 1.0)
    z = norm.ppf(rate)
    spread = np.sum(rate * (1.0 - rate) / (total * norm.pdf(z) ** 2))
    value, half = float(z[0] - z[1]), float(norm.ppf(0.975) * np.sqrt(spread))
    return value, (value - half, value + half), float(-0.5 * (z[0] + z[1]))


def sensitivities_of(answers: DataFrame, names: Sequence[str]) -> tuple[Sensitivity, ...]:
    """Sensitivity of all participants together and of each, of all trials and by factor, where there are two answers.

    names: Answers of the design, in its order. The signal is the answer that is right where the amplitude is above 0,
        in a design with catch trials (amplitude 0); these then are the noise trials of every level of the amplitude.
        Else it is the second answer, and levels of factors count where either answer is right in some of their trials.

    Empty where answers are not two, or only one is ever right.
    """
    import pandas as pd

    judged = answers[answers.correct.notna()]
    if len(names) != 2 or not len(judged):
        return ()
    other = judged.answer.map(lambda answer: names[1] if answer == names[0] else names[0])
    judged = judged.assign(right=judged.answer.where(judged.correct.astype(bool), other))
    catch = judged[judged.amplitude == 0.0]
    signal = names[int(catch.right.iloc[0] == names[0])] if len(catch) else names[1]
    noise = names[int(signal == names[0])]
    found = []
    for code, own in all_and_each(judged):
        for levels, part in [({}, own), *(group for factor in factors_of(judged) for group in groups(own, (factor,)))]:
            catch = own[own.amplitude == 0.0] if levels.get("amplitude", "0") != "0" else own[:0]
            pair = pd.concat([part, catch])
            with_signal, answered = pair.right == signal, pair.answer == signal
            hits, alarms = int((answered & with_signal).sum()), int((answered & ~with_signal).sum())
            counts = hits, int(with_signal.sum()), alarms, int((~with_signal).sum())
            if counts[1] and counts[3]:
                found.append(Sensitivity(code, levels, signal, noise, *counts, *d_prime(*counts)))
    return tuple(found)
