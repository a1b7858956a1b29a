"""Filters of live sources: at places between a bank's positions, by the kernel or by waves, and independent ones.

Independent sources are quiet at one another's places. At one frequency let h (1, N) be the Green's functions of a
source's own place, w0 = sigma h* (N, 1) the drives of time reversal with its saturation, and Q the rows of the places
where it is to be quiet. Its drives w, per unit of its signal, make

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

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration.numerics import evenly_spread, one_blas_thread
from wavefocus.calibration.wave_model import PatchKernel
from wavefocus.rendering.arrays import BoolArray, Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.base import SparseError
from wavefocus.rendering.greens.interpolation.errors import choose_interpolation
from wavefocus.rendering.greens.interpolation.kernel import KernelInterpolation
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.greens.interpolation.waves import WavesInterpolation
from wavefocus.rendering.greens.source import GreenSource, usable, well_measured
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.reader import DamagedError

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


PITCH_MM = 2.0
"""Places are at most so far apart along x and y; 1 mm makes independent sources quieter by 1 dB and takes 4 times the
memory."""


def finer_rows(bank: GreenSource, interpolation: str, signal: Float64Array) -> tuple[str, FinerRows | None]:
    """The interpolation in use, "auto" resolved, and the rows between the bank's that it takes, if any.

    signal: What sources emit, at the bank's rate; "auto" takes what errs least in its band, and "nearest" where the
        bank allows no rows between its positions, or needs none.

    Raises InputError: the bank does not allow the interpolation.
    """
    if interpolation == "auto":
        try:
            between_mm = _between(np.asarray(bank.position_mm, dtype=np.float64)[well_measured(bank)])
            if not len(between_mm):
                return "nearest", None  # the positions are as near to one another as such rows would be
            places_mm = between_mm[evenly_spread(len(between_mm), 40)]
            return finer_rows(bank, choose_interpolation(bank, places_mm, [signal]).name, signal)
        except DamagedError:
            raise
        except InputError:
            return "nearest", None
    if interpolation == "waves":
        return interpolation, _WaveRowsBetween(bank)
    return interpolation, _KernelRowsBetween(bank) if interpolation == "kernel" else None


def _between(position_mm: Float64Array) -> Float64Array:
    """Places (n, 2) at most `PITCH_MM` apart within the hull of positions, and not on one of them.

    Raises InputError: the positions are too few or on a line.
    """
    from scipy.spatial import Delaunay, QhullError

    grid = PositionGrid(position_mm)
    try:
        hull = Delaunay(position_mm)
    except (QhullError, ValueError):
        raise InputError(
            "interpolation is 'waves' or 'auto', but the measured positions are too few or on one line; use 'nearest'"
        ) from None
    axes = [np.arange(low, high, PITCH_MM) for low, high in zip(position_mm.min(0), position_mm.max(0), strict=True)]
    places_mm = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    away_mm = grid.nearest(places_mm)[1]
    inside = (hull.find_simplex(places_mm) >= 0) & (away_mm > PITCH_MM / 2) & (away_mm <= grid.spacing_mm)
    return places_mm[inside]


class _WaveRowsBetween:
    """Rows by waves from the actuators and from the rim, as `WavesInterpolation` has them.

    count: Number of rows between the bank's; their numbers follow on the bank's.

    Raises InputError: the bank does not allow waves.
    """

    def __init__(self, bank: GreenSource) -> None:
        self._method, self._rate_hz = WavesInterpolation(bank), float(bank.sample_rate_hz)
        own_mm = self._method.grid.position_mm
        between_mm = _between(own_mm)
        self.count = len(between_mm)
        self._added = self._method.rows.add(between_mm)
        self._grid = PositionGrid(np.concatenate([own_mm, between_mm]))
        self._row = np.concatenate([self._method.grid_row, bank.positions + np.arange(self.count)])

    def nearest(self, at_mm: Float64Array) -> Int64Array:
        """Rows (n,) nearest to places (n, 2)."""
        return np.asarray(self._row[self._grid.nearest(at_mm)[0]])

    def filters(self, of_row: Callable[[int], Complex64Array], bin_hz: Float64Array) -> Complex64Array:
        """Filters of time reversal of the rows between, complex64 (count, actuators, bins).

        of_row: Those of a row of the bank, (actuators, bins). bin_hz, float64 (bins,): Multiples of one frequency,
            from 0 on.
        """
        samples = round(self._rate_hz * (len(bin_hz) - 1) / bin_hz[-1])
        rows = self._method.rows
        found = np.empty((self.count, rows.actuators, len(bin_hz)), np.complex64)
        with one_blas_thread():
            for number, row in enumerate(self._added.tolist()):
                found[number] = np.fft.rfft(rows.green(row), n=samples, axis=1)[:, : len(bin_hz)].conj()
        return found


class _KernelRowsBetween:
    """Rows on a lattice finer than the bank's, by the kernel; `count` as of `_WaveRowsBetween`.

    A filter is the same for all samples, so that weights of neighbours are taken at the frequencies of blocks; what
    would come before the first tap or after the last is not cut.

    Raises InputError: the grid is not a lattice, or too coarse or too small for the kernel.
    """

    def __init__(self, bank: GreenSource) -> None:
        position_mm = np.asarray(bank.position_mm, dtype=np.float64)
        lattice = PositionGrid(position_mm).lattice
        if lattice is None:
            raise InputError("interpolation is 'kernel', and the positions are not on a lattice; use 'nearest'")
        self._kernel = KernelInterpolation(bank, position_mm[usable(bank)])
        parts = [max(1, int(np.ceil(pitch / PITCH_MM - 1e-6))) for pitch in lattice.pitch_mm]
        right, up = (part.ravel() for part in np.meshgrid(np.arange(parts[0]), np.arange(parts[1])))
        self._offset_mm = np.stack([right / parts[0], up / parts[1]], axis=1)[1:] * lattice.pitch_mm
        # Places that belong to a position lie between it and the next along both axes.
        at = lattice.row_at
        whole = (at[:-1, :-1] >= 0) & (at[1:, :-1] >= 0) & (at[:-1, 1:] >= 0) & (at[1:, 1:] >= 0)
        patches = {}
        for row in at[:-1, :-1][whole].tolist():
            try:
                patch = self._kernel.neighbourhoods.patch(row)
            except (SparseError, IndexError):
                continue
            if patch.rows[0] == row:
                patches[row] = patch
        shared = Counter(patch.key for patch in patches.values())
        # Positions whose neighbours lie alike that make a shape worth its matrices, 70 ms each; further ones are not
        # refined: most positions of a grid have one shape, and those near a curved rim one each.
        self._patches = sorted(
            (patch for patch in patches.values() if len(self._offset_mm) and shared[patch.key] >= 8),
            key=lambda patch: patch.key,
        )
        anchors = np.array([patch.rows[0] for patch in self._patches], dtype=np.int64)
        between_mm = (position_mm[anchors][:, None] + self._offset_mm).reshape(-1, 2)
        self._grid = PositionGrid(np.concatenate([position_mm, between_mm]))
        self.count = len(between_mm)

    def nearest(self, at_mm: Float64Array) -> Int64Array:
        """See `_WaveRowsBetween`."""
        return self._grid.nearest(at_mm)[0]

    def filters(self, of_row: Callable[[int], Complex64Array], bin_hz: Float64Array) -> Complex64Array:
        """See `_WaveRowsBetween`."""
        waves, made, key = self._kernel.waves.at(bin_hz), [], b""
        with one_blas_thread():
            for patch in self._patches:
                if patch.key != key:
                    key = patch.key
                    weights = PatchKernel(waves, patch.offset_mm).weights(self._offset_mm).astype(np.complex64).conj()
                around = np.stack([of_row(row) for row in patch.rows.tolist()])
                made.append((weights @ np.ascontiguousarray(around.transpose(2, 0, 1))).transpose(1, 2, 0))
        return np.ascontiguousarray(np.concatenate(made)) if made else np.zeros((0, 0, len(bin_hz)), np.complex64)


FinerRows = _WaveRowsBetween | _KernelRowsBetween
"""Places finer than the bank's grid, and filters at those between its positions."""
