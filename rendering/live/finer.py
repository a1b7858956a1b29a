"""Filters at places between a bank's positions, by kernel interpolation at the frequencies of live blocks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np

from wavefocus.calibration.blas import one_blas_thread
from wavefocus.calibration.wave_model import PatchKernel
from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.base import SparseError
from wavefocus.rendering.greens.interpolation.kernel import KernelInterpolation
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.greens.source import GreenSource, usable
from wavefocus.rendering.live.independent import Complex64Array
from wavefocus.storage.errors import InputError

PITCH_MM = 2.0
"""Places are at most so far apart along x and y; 1 mm makes independent sources quieter by 1 dB and takes 4 times the
memory."""
MIN_SHARED = 8
"""Positions whose neighbours lie alike that make a shape worth its matrices, 70 ms each; further ones are not refined:
most positions of a grid have one shape, and those near a curved rim one each."""


class FinerRows:
    """A lattice of places finer than the bank's grid, and the filters at those between its positions.

    Its rows are those of the bank, and behind them those between. A filter is the same for all samples, so that weights
    of neighbours are taken at the frequencies of blocks; what would come before the first tap or after the last is
    not cut.

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
        self._patches = sorted(
            (patch for patch in patches.values() if len(self._offset_mm) and shared[patch.key] >= MIN_SHARED),
            key=lambda patch: patch.key,
        )
        anchors = np.array([patch.rows[0] for patch in self._patches], dtype=np.int64)
        between_mm = (position_mm[anchors][:, None] + self._offset_mm).reshape(-1, 2)
        self._grid = PositionGrid(np.concatenate([position_mm, between_mm]))
        self.count = len(between_mm)

    def nearest(self, at_mm: Float64Array) -> Int64Array:
        """Rows (n,) nearest to places (n, 2)."""
        return self._grid.nearest(at_mm)[0]

    def filters(self, of_row: Callable[[int], Complex64Array], bin_hz: Float64Array) -> Complex64Array:
        """Filters of time reversal of the rows between, complex64 (count, actuators, bins).

        of_row: Those of a row of the bank, (actuators, bins). bin_hz, float64 (bins,): Frequencies.
        """
        waves, made, key = self._kernel.waves.at(bin_hz), [], b""
        with one_blas_thread():
            for patch in self._patches:
                if patch.key != key:
                    key = patch.key
                    weights = PatchKernel(waves, patch.offset_mm).weights(self._offset_mm).astype(np.complex64).conj()
                around = np.stack([of_row(row) for row in patch.rows.tolist()])
                made.append((weights @ np.ascontiguousarray(around.transpose(2, 0, 1))).transpose(1, 2, 0))
        return np.ascontiguousarray(np.concatenate(made)) if made else np.zeros((0, 0, len(bin_hz)), np.complex64)
