"""Foci of a scene in a field: instants, places, widths, artefacts, crosstalk (the paper's figure 4D, left)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from config.scene import Regularisation
from rendering.arrays import Float32Array, Float64Array, Int64Array
from rendering.device import fast_length
from rendering.field import metrics
from rendering.field.metrics import band_weights
from rendering.greens.regularisation import row_weights, saturation_threshold
from rendering.greens.source import GreenSource, read_row
from storage.errors import InputError

if TYPE_CHECKING:
    from storage.drive_file import Drive


FOCUS_RADIUS_MM = 15.0
"""A focus is searched for within this distance of its path point: about one wavelength at 300 Hz."""
MOST_INSTANTS = 64
QUIET = 0.25
"""Foci quieter than this part of the loudest one lie between two swings of the source's signal."""
NEEDED_NEIGHBOURS = 0.9
"""This part of the bank's positions around a focus must be compared before it is judged."""


@dataclass(frozen=True, slots=True)
class FocusInstant:
    """A focus and its instant.

    source, row: Index of the scene's source, bank row of the path point.
    start_sample, stop_sample: Emission window ``[n_m, n_{m+1})`` in samples since t = 0; the last window of a source
        ends with the drive.
    sample: The focus instant, in samples since t = 0: where within the emission window the predicted response at the
        path point is largest. For an impulse that is n_m itself.
    """

    source: int
    row: int
    start_sample: int
    stop_sample: int
    sample: int


@dataclass(frozen=True, slots=True)
class FocusTable:
    """Figures of each focus; NaN where the positions around it were not compared.

    intended_mm, float64 (K, 2): The path point on the grid.
    predicted_mm, scanned_mm, float64 (K, 2): Place of the largest magnitude within 15 mm of it, between grid points.
    predicted_width_mm, scanned_width_mm, float64 (K,): Full width at half maximum: diameter of the disk of equal area.
    scanned_artefact_db, float64 (K,): Largest magnitude beyond 15 mm over the largest within.
    """

    intended_mm: Float64Array
    predicted_mm: Float64Array
    scanned_mm: Float64Array
    predicted_width_mm: Float64Array
    scanned_width_mm: Float64Array
    scanned_artefact_db: Float64Array

    @property
    def from_intended_mm(self) -> Float64Array:
        """Distance from path point to scanned focus, shape (K,)."""
        return np.asarray(np.hypot(*(self.scanned_mm - self.intended_mm).T))

    @property
    def from_prediction_mm(self) -> Float64Array:
        """Distance from predicted to scanned focus, shape (K,)."""
        return np.asarray(np.hypot(*(self.scanned_mm - self.predicted_mm).T))

    @property
    def width_difference_mm(self) -> Float64Array:
        """Scanned minus predicted focal width, shape (K,)."""
        return self.scanned_width_mm - self.predicted_width_mm


def median_or_none(values: Float64Array) -> float | None:
    """Median of the elements that are finite, None when there are none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else None


def evenly(count: int, most: int) -> Int64Array:
    """At most so many indices of `count` items, evenly spread, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def emission_windows(drive: Drive) -> tuple[FocusInstant, ...]:
    """The scene's foci with their emission windows, at most 64 of them, each at its first sample."""
    end = round(drive.start_s * drive.sample_rate_hz) + drive.drive_v.shape[1]
    windows: list[FocusInstant] = []
    for source in np.unique(drive.focus_source):
        of_source = np.flatnonzero(drive.focus_source == source)
        of_source = of_source[np.argsort(drive.focus_sample[of_source], kind="stable")]
        start = drive.focus_sample[of_source]
        stop = np.append(start[1:], end)
        for focus, first, following in zip(of_source, start, stop, strict=True):
            row = int(drive.focus_position[focus])
            last = min(max(int(following), int(first) + 1), max(end, int(first) + 1))
            windows.append(FocusInstant(int(source), row, int(first), last, int(first)))
    return tuple(windows[index] for index in evenly(len(windows), MOST_INSTANTS))


def focus_instants(
    windows: tuple[FocusInstant, ...], predicted: Float32Array, first_sample: int
) -> tuple[FocusInstant, ...]:
    """Move each focus to its instant and leave the quiet ones out.

    predicted, float32 (len(windows), samples): Predicted response at each window's path point, NaN where not predicted.
    first_sample: Sample of the scene at which `predicted` starts (negative: the lead-in).
    """
    moved = list(windows)
    level = np.full(len(windows), np.nan)
    for index, (window, response) in enumerate(zip(windows, np.abs(predicted), strict=True)):
        part = response[window.start_sample - first_sample : window.stop_sample - first_sample]
        if part.size and np.all(np.isfinite(part)):
            moved[index] = replace(window, sample=window.start_sample + int(np.argmax(part)))
            level[index] = part.max()
    quietest = QUIET * float(np.nanmax(level)) if np.isfinite(level).any() else 0.0
    return tuple(one for one, loud in zip(moved, level, strict=True) if not loud < quietest)


def focus_table(
    instants: tuple[FocusInstant, ...],
    predicted: Float32Array,
    scanned: Float32Array,
    rows: Int64Array,
    position_mm: Float64Array,
    spacing_mm: float | None,
) -> FocusTable:
    """Find places and widths of the foci.

    predicted, scanned, float32 (len(instants), compared positions): The fields at the focus instants.
    rows, int64 (compared positions,): Their bank rows.
    position_mm, float64 (positions, 2): The bank's grid.
    spacing_mm: Its spacing; None when it has but one position.
    """
    count = len(instants)
    intended = np.array([position_mm[one.row] for one in instants]).reshape(count, 2)
    places, widths, artefacts = np.full((2, count, 2), np.nan), np.full((2, count), np.nan), np.full((2, count), np.nan)
    there = position_mm[rows]
    for index, point in enumerate(intended):
        possible = np.count_nonzero(np.hypot(*(position_mm - point).T) <= FOCUS_RADIUS_MM)
        compared = np.count_nonzero(np.hypot(*(there - point).T) <= FOCUS_RADIUS_MM)
        if spacing_mm is None or compared < NEEDED_NEIGHBOURS * possible:
            continue
        for kind, field in enumerate((predicted[index], scanned[index])):
            if (focus := metrics.focus_spot(there, field, point, FOCUS_RADIUS_MM, spacing_mm)) is not None:
                places[kind, index] = focus.at_mm
                widths[kind, index], artefacts[kind, index] = focus.width_mm, focus.artefact_db
    return FocusTable(intended, places[0], places[1], widths[0], widths[1], artefacts[1])


RESPONSE_BYTES = 2**29


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
        if 8 * len(rows) ** 2 * length > RESPONSE_BYTES:
            raise InputError(f"{len(rows)} path points are too many for a crosstalk table; choose fewer")
        keep = np.ones(length // 2 + 1)
        if bank.band_hz is not None:
            keep = band_weights(length, bank.sample_rate_hz, bank.band_hz).astype(np.float64)
        bins = np.flatnonzero(keep)
        threshold = saturation_threshold(regularisation, bank)
        greens = np.empty((len(rows), bank.actuators, len(bins)), dtype=np.complex128)
        driven = np.empty_like(greens)
        for place, row in enumerate(rows):
            scaled = read_row(bank, row)
            if scaled.silent:
                raise InputError(f"position {row} is all zeros, so not measured; choose another path")
            weights = row_weights(scaled, threshold, normalise=regularisation.normalise)
            spectrum = np.fft.rfft(scaled.values, length, axis=1)[:, bins]
            sigma = np.ones(bank.actuators) if weights.sigma is None else weights.sigma
            greens[place] = np.ldexp(1.0, scaled.exponent) * spectrum
            gain = np.ldexp(weights.gain, weights.gain_exponent + scaled.exponent)
            driven[place] = gain * sigma[:, None] * spectrum.conj()
        responses = np.einsum("mib,nib->mnb", greens, driven, optimize=True)
        responses *= keep[bins] * np.fft.rfft(emitted, length)[bins]
        # Lags from -(taps - 1) on: the focus instant is at `lead`.
        responses *= np.exp(-2j * np.pi * bins * self.lead / length)
        whole = np.zeros((len(rows), len(rows), length // 2 + 1), dtype=np.complex128)
        whole[..., bins] = responses
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
