"""Filters at places between a bank's positions, at the frequencies of live blocks: by the kernel, or by waves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np

from wavefocus.calibration.numerics import evenly_spread, one_blas_thread
from wavefocus.calibration.wave_model import PatchKernel
from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.auto import choose_interpolation
from wavefocus.rendering.greens.interpolation.base import SparseError
from wavefocus.rendering.greens.interpolation.kernel import KernelInterpolation
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.greens.interpolation.waves import WavesInterpolation
from wavefocus.rendering.greens.source import GreenSource, usable, well_measured
from wavefocus.rendering.live.independent import Complex64Array
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.reader import DamagedError

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
        return interpolation, WaveRowsBetween(bank)
    return interpolation, KernelRowsBetween(bank) if interpolation == "kernel" else None


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


class WaveRowsBetween:
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


class KernelRowsBetween:
    """Rows on a lattice finer than the bank's, by the kernel; `count` as of `WaveRowsBetween`.

    A filter is the same for all samples, so that weights of neighbours are taken at the frequencies of blocks; what
    would come before the first tap or after the last is not cut.

    Raises InputError: the grid is not a lattice, or too coarse or too small for the kernel.
    """

    def __init__(self, bank: GreenSource) -> None:
        position_mm = np.asarray(bank.position_mm, dtype=np.float64)
        lattice, rate_hz = PositionGrid(position_mm).lattice, float(bank.sample_rate_hz)
        if lattice is None:
            raise InputError("interpolation is 'kernel', and the positions are not on a lattice; use 'nearest'")
        self._kernel = KernelInterpolation(bank, position_mm[usable(bank)])
        self._rate_hz = rate_hz
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
        """See `WaveRowsBetween`."""
        return self._grid.nearest(at_mm)[0]

    def filters(self, of_row: Callable[[int], Complex64Array], bin_hz: Float64Array) -> Complex64Array:
        """See `WaveRowsBetween`."""
        waves, made, key = self._kernel.waves.at(bin_hz), [], b""
        with one_blas_thread():
            for patch in self._patches:
                if patch.key != key:
                    key = patch.key
                    weights = PatchKernel(waves, patch.offset_mm).weights(self._offset_mm).astype(np.complex64).conj()
                around = np.stack([of_row(row) for row in patch.rows.tolist()])
                made.append((weights @ np.ascontiguousarray(around.transpose(2, 0, 1))).transpose(1, 2, 0))
        return np.ascontiguousarray(np.concatenate(made)) if made else np.zeros((0, 0, len(bin_hz)), np.complex64)


FinerRows = WaveRowsBetween | KernelRowsBetween
"""Places finer than the bank's grid, and filters at those between its positions."""
