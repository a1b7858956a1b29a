"""Rows of a bank predicted by the waves of all others, each left out in turn.

With C the covariance of what is measured and M = (C^-1)_TT^-1, the errors at positions T that are left out together are
``M (C^-1 d)_T``, and M their covariance. In the terms of `posterior`, C^-1 = D^(-1/2) (1 - E E*) D^(-1/2) with
E = X B^(-1/2) (Woodbury). S. Sundararajan and S. Keerthi, Neural Computation 13, 1103 (2001).
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.calibration import BoolArray, Complex64Array, Complex128Array, Float64Array, Int64Array
from wavefocus.calibration.numerics import on_a_line, one_blas_thread

if TYPE_CHECKING:
    from wavefocus.calibration.coarse_grid.rim_waves import WavesFound

MIN_POSITIONS = 30
"""With fewer, waves predict little: 36 rows of a stadium, 25 mm apart, are all judged, of 28 next to none."""
MAX_ROWS = 12_000
"""More rows take over half a gigabyte, and lie on a grid fine enough for their neighbours."""
MIN_FREE = 1e-6
"""Least part of a row's variance that the others leave open."""


class RowsByWaves:
    """Leave-one-out predictions of all rows of a bank by waves from the actuators and from the rim.

    position_mm, float64 (positions, 2): In millimetres.
    actuator_mm, float64 (actuators, 2): Finite.
    values, complex128 (positions, actuators, frequencies): Fourier transforms of the rows.
    frequency_hz, float64 (frequencies,): Ascending, > 0.
    usable, bool (positions,): Rows that are there.
    found: Wave numbers and shares.

    Raises LinAlgError: no numbers are precise enough for rows with so little noise.

    spacing_mm: Median distance of neighbouring positions.
    neighbours: Of each position that can be predicted, itself and all others, the nearest first.
    """

    def __init__(
        self,
        position_mm: Float64Array,
        actuator_mm: Float64Array,
        values: Complex128Array,
        frequency_hz: Float64Array,
        usable: BoolArray,
        found: WavesFound,
    ) -> None:
        from wavefocus.calibration.coarse_grid.waves import grid_spacing_mm

        self.values, self._position_mm, self._rows = values, position_mm, np.flatnonzero(usable)
        self._number = np.full(len(values), -1)
        self._number[self._rows] = np.arange(len(self._rows))
        placed_mm = position_mm[self._rows]
        gap_mm = placed_mm[:, None] - placed_mm
        near = np.argsort(np.hypot(gap_mm[..., 0], gap_mm[..., 1]), axis=1, kind="stable")
        self.spacing_mm = grid_spacing_mm(placed_mm)
        self.neighbours: dict[int, Int64Array] = {
            int(row): self._rows[np.append(number, order[order != number])].astype(np.int64)
            for number, (row, order) in enumerate(zip(self._rows, near, strict=True))
        }
        with one_blas_thread():
            transfer = values[self._rows].transpose(2, 0, 1)
            self._waves = list(zip(found.at(placed_mm, actuator_mm, transfer), found.shares, strict=True))
            solved = [waves.whitened(shares) for waves, shares in self._waves]
        explained, left, noise = zip(*solved, strict=True)
        self._explained: Complex64Array = np.stack(explained, axis=1)
        self._left: Complex128Array = np.stack(left, axis=1)
        self._noise: Float64Array = np.stack(noise, axis=1)
        self._free: Float64Array = 1.0 - np.square(np.abs(self._explained)).sum(axis=3, dtype=np.float64)

    def errors_without(self, out: BoolArray) -> tuple[Complex128Array, Float64Array]:
        """Error of every row, left out together with some positions, and its expected square; NaN if none.

        Returns errors, variance : (positions, actuators, frequencies).
        """
        number = self._number[np.flatnonzero(out)]
        parts = [self._errors_of(actuator, number) for actuator in range(self.values.shape[1])]
        errors, variance = zip(*parts, strict=True)
        return np.stack(errors, axis=1), np.stack(variance, axis=1)

    def _errors_of(self, actuator: int, number: Int64Array) -> tuple[Complex128Array, Float64Array]:
        """The same of one actuator; `number` counts among the rows that are there."""
        errors = np.full((len(self.values), self.values.shape[2]), np.nan + 0j)
        variance = np.full(errors.shape, np.nan)
        explained, left, noise = self._explained[actuator], self._left[actuator], self._noise[actuator]
        of_out = explained[:, number].astype(np.complex128)
        inverse = np.linalg.inv(np.eye(len(number)) * (1.0 + MIN_FREE) - of_out @ of_out.conj().swapaxes(1, 2))
        between = -(explained @ of_out.conj().swapaxes(1, 2).astype(np.complex64))
        weights = between @ inverse
        free = np.maximum(self._free[actuator] - (weights * between.conj()).sum(axis=2).real, MIN_FREE)
        found = (left - (weights @ left[:, number, None])[..., 0]) / free
        found[:, number] = (inverse @ left[:, number, None])[..., 0]
        free[:, number] = 1.0 / np.maximum(np.diagonal(inverse, axis1=1, axis2=2).real, 1.0)
        errors[self._rows], variance[self._rows] = (noise * found).T, (np.square(noise) / free).T
        return errors, variance


def waves_of_rows(
    position_mm: Float64Array,
    actuator_mm: Float64Array,
    values: Complex128Array,
    frequency_hz: Float64Array,
    usable: BoolArray,
) -> WavesFound | None:
    """Find wave numbers and shares from rows, see `RowsByWaves`.

    None where these are few or very many, or on a line, actuators' places are unknown, or nothing fits.
    """
    places_mm = position_mm[usable]
    too_few = len(places_mm) < MIN_POSITIONS or len(places_mm) * len(actuator_mm) > MAX_ROWS
    if too_few or not (np.isfinite(actuator_mm).all() and np.isfinite(places_mm).all()) or on_a_line(places_mm):
        return None
    # SciPy's optimisation and interpolation are slow to load: only for who judges a coarse grid.
    from wavefocus.calibration.coarse_grid.rim_waves import judging_waves

    with one_blas_thread(), suppress(np.linalg.LinAlgError):
        return judging_waves(frequency_hz, places_mm, actuator_mm, values[usable].transpose(2, 0, 1))
    return None
