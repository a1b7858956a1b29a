"""Crosstalk between the foci of a path: the paper's figure 4D, left."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wavefocus.config.scene import Regularisation
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.device import fast_length
from wavefocus.rendering.field.metrics import band_weights
from wavefocus.rendering.greens.regularisation import row_weights, saturation_threshold
from wavefocus.rendering.greens.source import GreenSource, RowReader
from wavefocus.storage.errors import InputError


@dataclass(frozen=True, slots=True)
class CrosstalkTable:
    """Crosstalk over speed, (speeds,), and path sample distance d, (steps,).

    `energy_ratio`, (speeds, steps), is that of `PathResponses`; NaN where the path has fewer than two points.
    """

    speed_mm_s: Float64Array
    step_mm: Float64Array
    energy_ratio: Float64Array


class PathResponses:
    """Response at each of some rows to the focus at each of them.

    rows: Rows of the path's points, at most some dozens.
    signal, float64 (samples,): Emitted by every focus, at the bank's rate; by default an impulse.
    regularisation: Saturation and normalisation; by default normalised, without saturation.

    Raises InputError: a row is not measured, or the responses do not fit into memory.
    """

    def __init__(
        self,
        bank: GreenSource,
        rows: Sequence[int],
        signal: Float64Array | None = None,
        regularisation: Regularisation | None = None,
    ) -> None:
        emitted = np.ones(1) if signal is None else signal
        regularisation = regularisation or Regularisation()
        self.sample_rate_hz = float(bank.sample_rate_hz)
        self.lead = bank.taps - 1
        self._emitted = len(emitted)
        length = fast_length(2 * bank.taps - 1 + len(emitted) - 1)
        if 8 * len(rows) ** 2 * length > 2**29:
            raise InputError(f"{len(rows)} path points are too many for a crosstalk table; choose fewer")
        keep = np.ones(length // 2 + 1)
        if bank.band_hz is not None:
            keep = band_weights(length, bank.sample_rate_hz, bank.band_hz).astype(np.float64)
        bins = np.flatnonzero(keep)
        reader = RowReader(bank)
        threshold = saturation_threshold(regularisation, bank)
        greens = np.empty((len(rows), bank.actuators, len(bins)), dtype=np.complex128)
        driven = np.empty_like(greens)
        for place, row in enumerate(rows):
            green = reader.read(row)
            if not green.any():
                raise InputError(f"position {row} is all zeros, so not measured; choose another path")
            sigma, gain = row_weights(green, threshold, normalise=regularisation.normalise)
            spectrum = np.fft.rfft(green, length, axis=1)[:, bins]
            factors = np.full(bank.actuators, gain) if sigma is None else gain * sigma
            greens[place] = spectrum
            driven[place] = factors[:, None] * spectrum.conj()
        responses = np.einsum("mib,nib->mnb", greens, driven, optimize=True)
        responses *= keep[bins] * np.fft.rfft(emitted, length)[bins]
        # Lags from -(taps - 1) on: the focus instant is at `lead`.
        responses *= np.exp(-2j * np.pi * bins * self.lead / length)
        whole = np.zeros((len(rows), len(rows), length // 2 + 1), dtype=np.complex128)
        whole[..., bins] = responses
        # With normalisation a response is in the source's unit, without it in the square of the bank's.
        self.values: Float64Array = np.fft.irfft(whole, length, axis=2)

    def energy_ratio(self, speed_mm_s: float, step_mm: float, every: int = 1) -> float:
        """Crosstalk ratio of a source that moves from point to point; NaN with fewer than two points.

        Point m emits at ``n_m = round(m d / v)`` samples, d being `step_mm` > 0, the distance of the points that are
        used (`every` so many of the rows), and v the speed > 0. Over a window as long as the emissions are apart, its
        middle that of point m's emission (a focus converges as long as it diverges), the energy that all other points'
        foci together cause at point m is divided by that of its own focus; energies are summed over the points before
        they are divided. The paper (section IV.C) names the ratio of these energies and no window.
        """
        values = self.values[::every, ::every]
        points, length = values.shape[0], values.shape[2]
        if points < 2:
            return float("nan")
        instants = np.rint(np.arange(points + 1) * step_mm / speed_mm_s * self.sample_rate_hz).astype(np.int64)
        own_energy = others_energy = 0.0
        for m in range(points):
            period = max(int(instants[m + 1] - instants[m]), 1)
            window = instants[m] + (self._emitted - period) // 2 + np.arange(period)
            own = np.zeros(len(window))
            others = np.zeros(len(window))
            for other in range(points):
                lag = window - instants[other] + self.lead
                there = (lag >= 0) & (lag < length)
                target = own if other == m else others
                target[there] += values[m, other, lag[there]]
            own_energy += float(own @ own)
            others_energy += float(others @ others)
        return others_energy / own_energy if own_energy > 0 else float("nan")


def crosstalk_table(
    bank: GreenSource,
    rows: Sequence[int],
    row_step_mm: float,
    speeds_mm_s: Sequence[float],
    every: Sequence[int],
    signal: Float64Array | None = None,
    regularisation: Regularisation | None = None,
) -> CrosstalkTable:
    """Crosstalk along one line of `rows` that are `row_step_mm` apart, over speeds and path sample distances.

    The latter are `every`, in steps of the rows; for `signal` and `regularisation` see `PathResponses`.
    """
    responses = PathResponses(bank, rows, signal, regularisation)
    ratio = np.array(
        [[responses.energy_ratio(speed, row_step_mm * step, step) for step in every] for speed in speeds_mm_s]
    )
    return CrosstalkTable(np.asarray(speeds_mm_s, dtype=np.float64), row_step_mm * np.asarray(every, float), ratio)
