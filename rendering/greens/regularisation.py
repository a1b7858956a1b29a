"""Saturation (eq. 14) and gain normalisation (eq. 15) of the rows that a scene visits."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wavefocus.config.scene import Regularisation
from wavefocus.rendering.arrays import BoolArray, Float64Array, Int64Array
from wavefocus.rendering.greens.source import GreenSource, ScaledRow, fetch_row, read_row, refusal, scale_row, usable
from wavefocus.storage.errors import InputError

LEAST_TOTAL = 1e-300
"""The reciprocal of a smaller sum of energies is beyond the range of numbers."""


def rms_map(bank: GreenSource) -> Float64Array:
    """rms_i(x) of eq. (14) for every position and actuator.

    bank: Rows whose rms is not stored with the bank (`wavefocus.storage.bank.reading.Bank.rms`) are read, one by one.

    Returns float64 (positions, actuators): in the unit of the Green's functions; NaN in rows that are unmeasured,
    refused or all zeros. Raises InputError: a row in use holds NaN or infinity.
    """
    rms = np.full((bank.positions, bank.actuators), np.nan)
    in_use = usable(bank)
    stored = getattr(bank, "rms", None)
    if stored is not None:
        rms[in_use] = stored[in_use]
    for position in np.flatnonzero(in_use & np.isnan(rms).all(axis=1)):
        row = read_row(bank, int(position))
        if not row.silent:
            rms[position] = np.ldexp(_rms(row), row.exponent)
    return rms


def saturation_threshold(regularisation: Regularisation, bank: GreenSource) -> float:
    """Resolve C of eq. (14).

    regularisation: Saturation as a fraction of the median rms over all measured positions and all actuators, or
        absolute.
    bank: As of `rms_map`, where saturation is a fraction.

    Returns float: in the unit of the Green's functions; infinity where saturation is off. Raises InputError: the median
    is 0, so that a fraction of it means nothing, or so small a fraction of it is 0.
    """
    if regularisation.saturation_absolute:
        return float(regularisation.saturation_absolute)
    if not regularisation.saturation:
        return float("inf")
    rms = rms_map(bank)
    measured = rms[~np.isnan(rms)]
    median = float(np.median(measured)) if measured.size else 0.0
    if median == 0.0:
        raise InputError(
            f"saturation is {regularisation.saturation} of the bank's median rms, but that median is 0;"
            " use saturation_absolute"
        )
    with np.errstate(over="ignore", under="ignore"):
        threshold = float(np.float64(regularisation.saturation) * median)
    if threshold == 0.0:
        raise InputError(f"saturation is {regularisation.saturation}, too small for numbers; use 0 for off")
    return threshold


@dataclass(frozen=True, slots=True)
class RowWeights:
    """Regularisation of one focus position.

    sigma, float64 (actuators,), or None: Saturation factors; None where all are 1.
    gain, gain_exponent: n(x) = gain * 2**gain_exponent; 1 * 2**0 where normalisation is off.
    """

    sigma: Float64Array | None
    gain: float
    gain_exponent: int


def row_weights(row: ScaledRow, threshold: float, *, normalise: bool) -> RowWeights:
    """Evaluate eqs. (14) and (15) at one position.

    row: Its Green's functions, not all zero.
    threshold: C, > 0, infinity for off.
    normalise: Whether to form n(x).
    """
    sigma = None
    if np.isfinite(threshold):
        level = np.ldexp(_rms(row), row.exponent)
        saturated = level >= threshold
        if saturated.any():
            sigma = np.ones(len(level))
            sigma[saturated] = threshold / level[saturated]
    if not normalise:
        return RowWeights(sigma, 1.0, 0)
    energies = np.einsum("ij,ij->i", row.values, row.values, dtype=np.float64)
    total = float(energies.sum() if sigma is None else sigma @ energies)
    if not total > LEAST_TOTAL:
        raise InputError(f"the saturation threshold is {threshold:.3g}, too small for numbers; use a larger saturation")
    return RowWeights(sigma, 1.0 / total, -2 * row.exponent)


def focus_gain_map(bank: GreenSource, saturation: float | None = None) -> Float64Array:
    """n(x) of eq. (15) over the surface, the paper's figure 3C.

    saturation: C as a fraction of the bank's median rms; None or 0: off.

    Returns float64 (positions,): NaN where nothing was measured. Raises InputError: the saturation is not allowed, or
    n(x) does not fit into float64.
    """
    threshold = saturation_threshold(Regularisation(saturation=saturation or 0.0), bank)
    gain = np.full(bank.positions, np.nan)
    for position in np.flatnonzero(usable(bank)):
        row = read_row(bank, int(position))
        if row.silent:
            continue
        weights = row_weights(row, threshold, normalise=True)
        with np.errstate(over="ignore", under="ignore"):
            gain[position] = np.ldexp(weights.gain, weights.gain_exponent)
        if not (np.isfinite(gain[position]) and gain[position] > 0):
            raise InputError(
                f"n(x) at position {position} does not fit into float64: the bank's largest value there is"
                " about"
                f" 2**{row.exponent}; give the bank another unit"
            )
    return gain


def _rms(row: ScaledRow) -> Float64Array:
    # One actuator may stand far below the row's peak: its squares must not vanish.
    values = row.values.astype(np.float64, copy=False)
    peak = np.abs(values).max(axis=1)
    scale = np.where(peak > 0, peak, 1.0)
    if float(peak.min()) > 1e-140:
        scale = np.ones_like(peak)
    part = values if scale.max() == scale.min() == 1.0 else values / scale[:, None]
    rms: Float64Array = np.sqrt(np.einsum("ij,ij->i", part, part) / part.shape[1]) * scale
    return rms


PLAIN_EXPONENT = 300
"""Drives within 2**300 of 1 are accumulated as they are."""


class BankRows:
    """The rows that a scene visits, read, judged and regularised."""

    needed_by: Callable[[int, Float64Array], str]
    """Source and path point that need a row at a place, for a message."""

    def __init__(self, bank: GreenSource, regularisation: Regularisation) -> None:
        self.bank = bank
        self.needed_by = lambda row, at_mm: "the scene"
        self.status = np.asarray(bank.status)
        self._position_mm = np.asarray(bank.position_mm, dtype=np.float64)
        # Rows that an interpolation adds say nothing of the bank's median.
        measured: GreenSource = getattr(bank, "measured", bank)
        self.threshold = saturation_threshold(regularisation, measured)
        self._normalise = regularisation.normalise
        self._weights: dict[int, RowWeights] = {}
        self._exponent: dict[int, int] = {}
        self._drive_exponent: int | None = None
        # Files are read by one thread at a time.
        self._reading = threading.Lock()
        self._loud = np.zeros(bank.actuators, dtype=bool)

    @property
    def used(self) -> list[int]:
        """Rows read so far, in ascending order."""
        return sorted(self._weights)

    @property
    def silent_actuators(self) -> list[int]:
        """Actuators whose Green's functions are zero in every row read so far."""
        return [int(actuator) for actuator in np.flatnonzero(~self._loud)] if self._weights else []

    def read(self, row: int, *, single: bool = False) -> ScaledRow:
        """Read a row. Raises InputError where it may not be used, saying which path point needs it.

        Several threads may read. With `single` the values are float32.
        """
        reason = refusal(int(self.status[row]))
        scaled = None
        if not reason:
            with self._reading:
                raw = fetch_row(self.bank, row)
            scaled = scale_row(raw, row)
        if scaled is None or scaled.silent:
            x, y = self._position_mm[row]
            raise InputError(
                f"position {row} at ({x:.6g}, {y:.6g}) mm is {reason or 'all zeros, so not measured'}, but"
                f" {self.needed_by(row, self._position_mm[row])} needs it; remeasure the position or move"
                " the path"
            )
        if row not in self._weights:
            self._loud |= scaled.values.any(axis=1)
            self._exponent[row] = scaled.exponent
            self._weights[row] = row_weights(scaled, self.threshold, normalise=self._normalise)
        return scaled.rounded() if single else scaled

    def sigma(self, regularised_by: int) -> Float64Array | None:
        """Saturation factors (actuators,) of a row, None where all are 1."""
        return self._known(regularised_by).sigma

    def weigh(self, rows: Int64Array, regularised_by: Int64Array, exponent: int = 0) -> tuple[Float64Array, BoolArray]:
        """Weights of rows, each regularised by another or by itself.

        rows, regularised_by, int64 (k,): Bank rows.
        exponent: The factors are divided by 2**exponent.

        Returns factors : float64 (k,): n(regularised_by) times the scale of the row, over 2**(drive_exponent +
        exponent); saturated : bool (k,): where `sigma` is not None.
        """
        factors, saturated = np.empty(len(rows)), np.empty(len(rows), dtype=bool)
        for place, (row, by) in enumerate(zip(rows.tolist(), regularised_by.tolist(), strict=True)):
            weights = self._known(by)
            self._known(row)
            power = weights.gain_exponent + self._exponent[row]
            if self._drive_exponent is None:
                self._drive_exponent = power if abs(power) > PLAIN_EXPONENT else 0
            try:
                factors[place] = math.ldexp(weights.gain, power - self._drive_exponent - exponent)
            except OverflowError:
                factors[place] = np.inf
            saturated[place] = weights.sigma is not None
        return factors, saturated

    @property
    def drive_exponent(self) -> int:
        """Power of two that the drives are still to be multiplied with.

        It keeps a bank of tiny numbers from being accumulated in denormals, which are slow and inexact.
        """
        return self._drive_exponent or 0

    def _known(self, row: int) -> RowWeights:
        if row not in self._weights:
            self.read(row)
        return self._weights[row]
