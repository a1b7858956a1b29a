"""A generalised linear mixed model of the right answers: the optional package statsmodels fits it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.errors import InputError
from wavefocus.trials.analysis.shares import factors_of, grouped, level_of
from wavefocus.trials.answers import Row

MOST_CATEGORIES = 5
"""A numeric factor with more levels enters by its common logarithm, any other by one term per level but the first."""
PRIOR_SD = 2.0


@dataclass(frozen=True, slots=True)
class Term:
    """A fixed effect on the log odds of a right answer: posterior mean, standard deviation, 95 % interval."""

    name: str
    mean: float
    sd: float
    interval: tuple[float, float]


@dataclass(frozen=True, slots=True)
class MixedModel:
    """The model logit P(right) = fixed effects + a random intercept of each participant.

    terms: The intercept, and each factor; a level is against the factor's first.
    participants_sd: Standard deviation of the participants' intercepts.
    """

    of: int
    participants: int
    terms: tuple[Term, ...]
    participants_sd: float


def fit_mixed_model(rows: Sequence[Row]) -> MixedModel:
    """Fit the model with ``BinomialBayesMixedGLM`` of statsmodels, in two steps.

    The variational approximation (`fit_vb`) gives the participants' standard deviation, its logarithm with a prior
    standard deviation of 1; at this value the Laplace approximation (`fit_map`) gives the fixed effects and their
    errors. Alone, the former has too small errors of the intercept, and the latter a standard deviation of 0. Prior
    standard deviation of fixed effects: 2, which keeps them finite where all answers are right.

    Raises InputError: statsmodels is missing, participants are fewer than two, no answer is right or wrong, or the fit
    does not converge.
    """
    judged = [row for row in rows if row.correct is not None]
    codes = sorted({row.participant for row in judged})
    if len(codes) < 2:
        raise InputError(
            f"--mixed-model needs right and wrong answers of two or more participants; here are those of {len(codes)}"
        )
    try:
        from statsmodels.genmod.bayes_mixed_glm import BinomialBayesMixedGLM
    except ImportError:
        raise InputError(
            "--mixed-model needs the package statsmodels; install it with: pip install 'wavefocus[statistics]'"
        ) from None
    right = np.array([float(bool(row.correct)) for row in judged])
    names, columns = _fixed_effects(judged)
    whose = np.array([[float(row.participant == code) for code in codes] for row in judged])
    one_variance = np.zeros(len(codes), np.int64)

    def model(random_effects: NDArray[np.float64], prior_sd: float) -> Any:
        return BinomialBayesMixedGLM(right, columns, random_effects, one_variance, vcp_p=prior_sd, fe_p=PRIOR_SD)

    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        try:
            participants_sd = float(np.exp(model(whose, 1.0).fit_vb().vcp_mean[0]))
            # The prior of the standard deviation is 1 times that of the columns: here it stays what was found.
            found = model(participants_sd * whose, 1e-3).fit_map(minim_opts={"gtol": 1e-3})
        except UserWarning as error:
            raise InputError(f"--mixed-model: the fit does not converge: {error}") from None
    terms = tuple(
        Term(name, float(mean), float(sd), (float(mean - 1.96 * sd), float(mean + 1.96 * sd)))
        for name, mean, sd in zip(names, found.fe_mean, found.fe_sd, strict=True)
    )
    return MixedModel(len(judged), len(codes), terms, participants_sd)


def _fixed_effects(rows: Sequence[Row]) -> tuple[list[str], NDArray[np.float64]]:
    """Names of the fixed effects, and their values (trial, effect)."""
    names, columns = ["intercept"], [np.ones(len(rows))]
    for factor in factors_of(rows):
        levels = [level for (level,) in grouped(rows, (factor,))]
        values = [getattr(row, factor) for row in rows]
        if len(levels) > MOST_CATEGORIES and all(isinstance(one, float) and one > 0 for one in values):
            names.append(f"log10({factor})")
            columns.append(np.log10(np.array(values, np.float64)))
            columns[-1] -= columns[-1].mean()
            continue
        for level in levels[1:]:
            column = np.array([float(level_of(row, factor) == level) for row in rows])
            # A level that parts the trials as another factor's does adds nothing.
            if np.linalg.matrix_rank(np.stack([*columns, column])) > len(columns):
                names.append(f"{factor}: {level} against {levels[0]}")
                columns.append(column)
    return names, np.stack(columns, axis=1)
