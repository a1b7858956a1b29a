"""Filters of sources that are quiet at one another's places.

At one frequency let h (1, N) be the Green's functions of a source's own place, and q_k those of the places where it is
to be quiet. Its drives w (N, 1), per unit of its signal, make

    |w|^2 + mu sum_k |q_k w|^2

least under h w = |h|^2, which is the response that time reversal, w = h*, has at its own place. With A = I + mu Q* Q,
Q the rows q_k, that is w ~ A^-1 h*. By Woodbury's identity this lies in the span of all rows, G = (h; Q):

    w ~ G* x,  (G G* + I / mu) x = e_1.

So one inverse of a small matrix for each frequency serves all sources: each takes the column of its own place, after
elimination of places of its own that are no quiet places for itself (the Schur complement). Scaling gives h w = |h|^2.

Where places are so near to one another that the energy |w|^2 would exceed E times |h|^2, that of time reversal,
w = h* + t (w - h*) takes its place: h (w - h*) = 0, so that |w|^2 = |h|^2 + t^2 |w - h*|^2, and t makes it E times.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Complex64Array = NDArray[np.complex64]

QUIET_DB = -40.0
"""1 / mu, over the mean of |h|^2 over all places and frequencies."""
MAX_ENERGY = 10.0
"""E, at every frequency."""


def independent_filters(
    green: Complex64Array, own: Sequence[Sequence[int]], *, quiet_db: float = QUIET_DB, max_energy: float = MAX_ENERGY
) -> Complex64Array:
    """Filters of sources, each quiet at the others' places.

    green, complex64 (bins, places, actuators): Green's functions of all places, none twice.
    own: Of each source the indices of its own places: the one that it sounds at, and others where it need not be quiet.
    quiet_db: 1 / mu, over the mean of |h|^2.
    max_energy: E, >= 1.

    Returns complex64 (bins, sources, actuators).
    """
    conjugate = green.conj()
    gram = green @ conjugate.transpose(0, 2, 1)
    places = np.arange(gram.shape[1])
    gram[:, places, places] += 10.0 ** (quiet_db / 10.0) * gram[:, places, places].real.mean()
    inverse = np.linalg.inv(gram)
    mixing = np.stack([_column(inverse, list(dict.fromkeys(mine))) for mine in own], axis=1)
    filters = mixing @ conjugate
    at = [mine[0] for mine in own]
    reversed_in_time = conjugate[:, at]
    response = (green[:, at] * filters).sum(axis=2)
    plain = np.square(np.abs(reversed_in_time)).sum(axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        filters *= np.nan_to_num(plain / response, nan=0.0, posinf=0.0, neginf=0.0)[..., None]
    beyond = filters - reversed_in_time
    excess = np.square(np.abs(beyond)).sum(axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.sqrt((max_energy - 1.0) * plain / excess)
    result: Complex64Array = reversed_in_time + beyond * np.fmin(share, 1.0)[..., None].astype(np.float32)
    return result


def _column(inverse: Complex64Array, own: list[int]) -> Complex64Array:
    """The column of the first place in the inverse without the others, 0 in their rows, (bins, places)."""
    columns = inverse[:, :, own]
    for index in range(1, len(own)):
        pivot = columns[:, own[index], index]
        for other in (0, *range(index + 1, len(own))):
            columns[:, :, other] -= columns[:, :, index] * (columns[:, own[index], other] / pivot)[:, None]
    return columns[:, :, 0]
