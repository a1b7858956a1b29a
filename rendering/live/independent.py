"""Filters of sources that are quiet at one another's places.

At one frequency let h (1, N) be the Green's functions of a source's own place, w0 = sigma h* (N, 1) the drives of time
reversal with its saturation, and Q the rows of the places where it is to be quiet. Its drives w, per unit of its
signal, make

    |w - w0|^2 + mu |Q w|^2

least under h w = h w0. Without saturation that is the least energy |w|^2, since |w - h*|^2 = |w|^2 - |h|^2. What is
added lies in the span of all rows, G = (h; Q): w = w0 - G* y. With y_q = mu q w at the quiet places, b = (0; Q w0) and
h G* y = 0 that is

    (G G* + I / mu) y = b + t e_h,    t = y_h / mu.

So one inverse of a small matrix for each frequency serves all sources. Places of its own where a source need not be
quiet are eliminated (Schur complement).

Where places are so near to one another that |w|^2 would exceed E times |w0|^2, as much of G* y is subtracted as E
allows: the response at the own place stays what it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import BoolArray

Complex64Array = NDArray[np.complex64]

QUIET_DB = -40.0
"""1 / mu, over the mean of |h|^2 over all places and frequencies."""
MAX_ENERGY = 10.0
"""E, at every frequency."""


def independent_filters(
    green: Complex64Array,
    own: Sequence[Sequence[int]],
    plain: Complex64Array,
    *,
    quiet_db: float = QUIET_DB,
    max_energy: float = MAX_ENERGY,
) -> tuple[Complex64Array, BoolArray]:
    """Filters of sources, each quiet at the others' places.

    green, complex64 (bins, places, actuators): Green's functions of all places, none twice.
    own: Of each source the indices of its own places: the one that it sounds at, and others where it need not be quiet.
    plain, complex64 (bins, sources, actuators): Filters of time reversal, w0.
    quiet_db: 1 / mu, over the mean of |h|^2.
    max_energy: E, >= 1.

    Returns complex64 (bins, sources, actuators), and whether E acts, bool (bins, sources).
    """
    conjugate = green.conj()
    gram = green @ conjugate.transpose(0, 2, 1)
    places = np.arange(gram.shape[1])
    floor = max(10.0 ** (quiet_db / 10.0) * float(gram[:, places, places].real.mean()), 1e-30)
    gram[:, places, places] += floor
    inverse = np.linalg.inv(gram)
    loud = green @ plain.transpose(0, 2, 1)
    for source, mine in enumerate(own):
        loud[:, list(mine), source] = 0.0
    answers = inverse @ loud
    at, of_own = [mine[0] for mine in own], inverse[:, :, [mine[0] for mine in own]]
    for source, mine in enumerate(own):
        if len(others := list(dict.fromkeys(mine))) > 1:
            answers[:, :, source], of_own[:, :, source] = _eliminated(answers[:, :, source], inverse, others)
    sources = np.arange(len(own))
    share = floor * answers[:, at, sources] / np.maximum(1.0 - floor * of_own[:, at, sources].real, 1e-6)
    change = -((answers + of_own * share[:, None]).transpose(0, 2, 1) @ conjugate)
    with np.errstate(divide="ignore", invalid="ignore"):
        # To the last digit, also where places can hardly be told apart.
        heard = (green[:, at] * change).sum(axis=2) / np.square(np.abs(green[:, at])).sum(axis=2)
        change -= conjugate[:, at] * np.nan_to_num(heard, posinf=0.0, neginf=0.0)[..., None]
        # The part of the change with which the energy is E times that of time reversal.
        power = np.square(np.abs(plain)).sum(axis=2, dtype=np.float64)
        changed = np.square(np.abs(change)).sum(axis=2, dtype=np.float64)
        along = (plain.conj() * change).real.sum(axis=2, dtype=np.float64)
        part = (np.sqrt(along**2 + (max_energy - 1.0) * power * changed) - along) / changed
    return np.asarray(plain + change * np.fmin(part, 1.0)[..., None], dtype=np.complex64), part < 1.0


def _eliminated(answer: Complex64Array, inverse: Complex64Array, own: list[int]) -> tuple[NDArray[Any], NDArray[Any]]:
    """The inverse times b and times e_h for one source, (bins, places), 0 in the rows of its other own places.

    answer: The inverse times b.
    """
    columns = np.concatenate([answer[:, :, None], inverse[:, :, own]], axis=2)
    for index in range(2, columns.shape[2]):
        place = own[index - 1]
        pivot = columns[:, place, index]
        for other in (0, 1, *range(index + 1, columns.shape[2])):
            columns[:, :, other] -= columns[:, :, index] * (columns[:, place, other] / pivot)[:, None]
    return columns[:, :, 0], columns[:, :, 1]
