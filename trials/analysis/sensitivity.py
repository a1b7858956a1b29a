"""Sensitivity d' and criterion of answers of two kinds, by the theory of signal detection."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from wavefocus.trials.analysis.shares import Z_95, factors_of, grouped
from wavefocus.trials.answers import Row


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """Sensitivity of one group of trials.

    participant, factors: As of `wavefocus.trials.analysis.shares.Share`.
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
    from scipy.special import ndtri

    spread, z = 0.0, []
    for count, of in ((hits, of_signal), (false_alarms, of_noise)):
        rate = (count + 0.5) / (of + 1.0)
        z.append(float(ndtri(rate)))
        density = math.exp(-0.5 * z[-1] ** 2) / math.sqrt(2.0 * math.pi)
        spread += rate * (1.0 - rate) / (of * density**2)
    value, half = z[0] - z[1], Z_95 * math.sqrt(spread)
    return value, (value - half, value + half), -0.5 * (z[0] + z[1])


def sensitivities_of(rows: Sequence[Row], answers: Sequence[str]) -> tuple[Sensitivity, ...]:
    """Sensitivity of all participants together and of each, of all trials and by factor, where there are two answers.

    answers: Of the design, in its order. The signal is the answer that is right where the amplitude is above 0, in a
        design with catch trials (amplitude 0); these then are the noise trials of every level of the amplitude. Else it
        is the second answer, and levels of factors count where either answer is right in some of their trials.

    Empty where answers are not two, or one alone is ever right.
    """
    judged = [row for row in rows if row.correct is not None]
    if len(answers) != 2 or not judged:
        return ()
    catch = [row for row in judged if row.amplitude == 0.0]
    signal = _other(_right(catch[0], answers), answers) if catch else answers[1]
    codes = sorted({row.participant for row in judged})
    found: list[Sensitivity] = []
    for code in ("", *codes):
        some = [row for row in judged if code in ("", row.participant)]
        found += _group(some, code, {}, signal, answers)
        for factor in factors_of(judged):
            for (level,), part in grouped(some, (factor,)).items():
                shared = [row for row in some if row.amplitude == 0.0] if factor == "amplitude" and level != "0" else []
                found += _group([*part, *shared], code, {factor: level}, signal, answers)
    return tuple(found)


def _group(
    rows: Sequence[Row], code: str, factors: Mapping[str, str], signal: str, answers: Sequence[str]
) -> Iterator[Sensitivity]:
    with_signal = [row for row in rows if _right(row, answers) == signal]
    without = [row for row in rows if _right(row, answers) != signal]
    if not with_signal or not without:
        return
    hits, alarms = (sum(row.answer == signal for row in some) for some in (with_signal, without))
    counts = hits, len(with_signal), alarms, len(without)
    yield Sensitivity(code, factors, signal, _other(signal, answers), *counts, *d_prime(*counts))


def _right(row: Row, answers: Sequence[str]) -> str:
    """The right answer of two."""
    return row.answer if row.correct else _other(row.answer, answers)


def _other(answer: str, answers: Sequence[str]) -> str:
    return answers[1] if answer == answers[0] else answers[0]
