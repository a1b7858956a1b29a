"""Saturation (eq. 14) and gain normalisation (eq. 15) of the rows that a scene visits."""

from collections.abc import Callable

import numpy as np

from wavefocus.config.scene import Regularisation
from wavefocus.rendering.arrays import BoolArray, Float64Array, Int64Array
from wavefocus.rendering.greens.source import GreenSource, RealArray, RowReader, refusal, usable
from wavefocus.storage.errors import InputError

RowWeights = tuple[Float64Array | None, float]


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
    missing = np.flatnonzero(in_use & np.isnan(rms).all(axis=1)).tolist()
    if missing:
        reader = RowReader(bank)
        for position in missing:
            row = reader.read(position)
            if row.any():
                rms[position] = _rms(row)
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


def row_weights(green: Float64Array, threshold: float, *, normalise: bool) -> RowWeights:
    """Evaluate eqs. (14) and (15) at one position.

    green, (actuators, taps): Its Green's functions, not all zero, of values whose squares are in range.
    threshold: C in their unit, > 0, infinity for off.
    normalise: Whether to form n(x).

    Returns the saturation factors, float64 (actuators,), None where all are 1; and n(x), 1 where normalisation is off.
    """
    sigma = None
    if np.isfinite(threshold):
        level = _rms(green)
        saturated = level >= threshold
        if saturated.any():
            sigma = np.ones(len(level))
            sigma[saturated] = threshold / level[saturated]
    if not normalise:
        return sigma, 1.0
    energies = np.einsum("ij,ij->i", green, green)
    total = float(energies.sum() if sigma is None else sigma @ energies)
    # The reciprocal of a smaller sum of energies is beyond the range of numbers.
    if not total > 1e-300:
        raise InputError(f"the saturation threshold is {threshold:.3g}, too small for numbers; use a larger saturation")
    return sigma, 1.0 / total


def focus_gain_map(bank: GreenSource, regularisation: Regularisation) -> Float64Array:
    """n(x) of eq. (15) over the surface, the paper's figure 3C.

    Returns float64 (positions,): NaN where nothing was measured. Raises InputError: the saturation is not allowed, or
    n(x) does not fit into float64.
    """
    threshold = saturation_threshold(regularisation, bank)
    reader, gain = RowReader(bank), np.full(bank.positions, np.nan)
    for position in np.flatnonzero(usable(bank)).tolist():
        row = reader.read(position)
        if row.any():
            gain[position] = row_weights(row, threshold, normalise=True)[1]
    wrong = np.flatnonzero((gain == 0) | np.isinf(gain))
    if len(wrong):
        raise InputError(
            f"n(x) at position {wrong[0]} does not fit into float64; give the bank another unit, so that its values are"
            " nearer to 1"
        )
    return gain


def _rms(green: Float64Array) -> Float64Array:
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", green, green) / green.shape[1]))


class BankRows:
    """The rows that a scene visits, read, judged and regularised.

    needed_by: Says which source and path point need a row at a place, for a message.
    """

    def __init__(
        self,
        bank: GreenSource,
        regularisation: Regularisation,
        needed_by: Callable[[int, Float64Array], str] = lambda row, at_mm: "the scene",
    ) -> None:
        self.bank, self._needed_by = bank, needed_by
        self.status = np.asarray(bank.status)
        self._position_mm = np.asarray(bank.position_mm, dtype=np.float64)
        self._reader = RowReader(bank)
        # Rows that an interpolation adds say nothing of the bank's median.
        self._threshold = saturation_threshold(regularisation, getattr(bank, "measured", bank))
        self._normalise = regularisation.normalise
        self._weights: dict[int, RowWeights] = {}
        self._loud = np.zeros(bank.actuators, dtype=bool)

    @property
    def taps(self) -> int:
        """Length of a row in samples."""
        return self.bank.taps

    @property
    def used(self) -> list[int]:
        """Rows read so far, in ascending order."""
        return sorted(self._weights)

    @property
    def silent_actuators(self) -> list[int]:
        """Actuators whose Green's functions are zero in every row read so far."""
        return [int(actuator) for actuator in np.flatnonzero(~self._loud)] if self._weights else []

    def read(self, row: int, *, single: bool = False) -> RealArray:
        """Read a row as `RowReader` does; several threads may read.

        Raises InputError where it may not be used, saying which path point needs it.
        """
        green = self._measured(row)
        return green.astype(np.float32) if single else green

    def _measured(self, row: int) -> Float64Array:
        reason = refusal(int(self.status[row]))
        green = None if reason else self._reader.read(row)
        if green is None or not green.any():
            x, y = self._position_mm[row]
            raise InputError(
                f"position {row} at ({x:.6g}, {y:.6g}) mm is {reason or 'all zeros, so not measured'}, but"
                f" {self._needed_by(row, self._position_mm[row])} needs it; remeasure the position or move"
                " the path"
            )
        if row not in self._weights:
            self._loud |= green.any(axis=1)
            self._weights[row] = row_weights(green, self._threshold, normalise=self._normalise)
        return green

    def sigma(self, regularised_by: int) -> Float64Array | None:
        """Saturation factors (actuators,) of a row, None where all are 1."""
        return self._of(regularised_by)[0]

    def weigh(self, regularised_by: Int64Array) -> tuple[Float64Array, BoolArray]:
        """n(x) of rows, float64 (k,), and where `sigma` is not None, bool (k,).

        regularised_by, int64 (k,): Bank rows.
        """
        weights = [self._of(row) for row in regularised_by.tolist()]
        saturated = np.array([sigma is not None for sigma, _ in weights], dtype=bool)
        return np.array([gain for _, gain in weights]), saturated

    def _of(self, row: int) -> RowWeights:
        if row not in self._weights:
            self._measured(row)
        return self._weights[row]
