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

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import BoolArray, Float64Array

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

    green, complex64 (places, actuators, bins): Green's functions of all places, none twice.
    own: Of each source the indices of its own places: the one that it sounds at, and others where it need not be quiet.
    plain, complex64 (sources, actuators, bins): Filters of time reversal, w0.
    quiet_db: 1 / mu, over the mean of |h|^2.
    max_energy: E, >= 1.

    Returns complex64 (sources, actuators, bins), and whether E acts, bool (sources, bins).
    """
    places, sources = np.arange(len(green)), np.arange(len(own))
    at = [mine[0] for mine in own]
    by_bin = np.ascontiguousarray(green.transpose(2, 0, 1))
    conjugate = by_bin.conj()
    heard = np.concatenate([conjugate, plain.transpose(2, 0, 1)], axis=1)
    system = np.ascontiguousarray((by_bin @ heard.transpose(0, 2, 1)).transpose(1, 2, 0))
    power = system[places, places].real.copy()
    floor = max(10.0 ** (quiet_db / 10.0) * float(power.mean()), 1e-30)
    system[places, places] += floor
    for source, mine in enumerate(own):
        system[list(mine), len(places) + source] = 0.0
    _solve(system)
    answers, of_own = system[:, len(places) :], system[:, at]
    for source, mine in enumerate(own):
        if len(others := list(dict.fromkeys(mine))) > 1:
            columns = np.stack([answers[:, source], of_own[:, source], *(system[:, place] for place in others[1:])])
            answers[:, source], of_own[:, source] = _eliminated(columns, others[1:])
    share = floor * answers[at, sources] / np.maximum(1.0 - floor * of_own[at, sources].real, 1e-6)
    mixed = np.ascontiguousarray((answers + of_own * share).transpose(2, 1, 0))
    change = np.ascontiguousarray((mixed @ -conjugate).transpose(1, 2, 0))
    # The response at the own place stays to the last digit, also where places can hardly be told apart.
    focus = green[at]
    left = np.einsum("snb,snb->sb", focus, change) / np.maximum(power[at], 1e-30)
    change -= focus.conj() * left[:, None]
    # The part of the change with which the energy is E times that of time reversal.
    most, changed = (max_energy - 1.0) * _energy(plain, plain), _energy(change, change)
    along = _energy(plain, change)
    with np.errstate(divide="ignore", invalid="ignore"):
        part = (np.sqrt(along**2 + most * changed) - along) / changed
    change *= np.fmin(part, 1.0).astype(np.float32)[:, None]
    return plain + change, part < 1.0


def _energy(first: Complex64Array, second: Complex64Array) -> Float64Array:
    """Real part of the product of filters (sources, actuators, bins), (sources, bins)."""
    product: Complex64Array = np.einsum("snb,snb->sb", first.conj(), second)
    return product.real.astype(np.float64)


def _solve(system: Complex64Array) -> None:
    """Turn (A, B), (n, n + m, bins), into (A^-1, A^-1 B), by Gauss and Jordan without pivoting; A is positive definite.

    One place after the other for all bins takes half the time of LAPACK, matrix by matrix.
    """
    for place in range(len(system)):
        row, column = system[place] / system[place, place], system[:, place].copy()
        row[place], column[place] = 1.0 / system[place, place], 0.0
        system[:, place] = 0.0
        system[place] = row
        system -= column[:, None] * row


def _eliminated(columns: Complex64Array, places: list[int]) -> Complex64Array:
    """The first columns less so much of the last ones that they are 0 at some places.

    columns, complex64 (k + m, n, bins): The last m are those of the inverse at these places, one for each.
    """
    for place in reversed(places):
        columns, last = columns[:-1], columns[-1]
        columns -= last * (columns[:, place] / last[place])[:, None]
    return columns
