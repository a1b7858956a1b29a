"""Waves in a bank and in responses: correlation over distance, travel of impulses, spectra and crosstalk on paths."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.config.scene import Regularisation
from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.device import fast_length
from wavefocus.rendering.field.metrics import band_limited, band_weights
from wavefocus.rendering.greens.regularisation import row_weights, saturation_threshold
from wavefocus.rendering.greens.source import GreenSource, RowReader, usable
from wavefocus.storage.errors import InputError


@dataclass(frozen=True, slots=True)
class DistanceCorrelation:
    """Correlation coefficients by distance.

    All have one element per bin: mean distance of its pairs; mean, 10 % and 90 % quantile over pairs of positions and
    over actuators.
    """

    distance_mm: Float64Array
    mean: Float64Array
    low: Float64Array
    high: Float64Array


def correlation_over_distance(bank: GreenSource, edges_mm: Sequence[float], rows: Sequence[int]) -> DistanceCorrelation:
    """Correlate the Green's functions of pairs of positions.

    The coefficient is that at lag 0, ``<g_i(x), g_i(x')> / (||g_i(x)|| ||g_i(x')||)``, means not removed, for
    each actuator i: what eqs. (10) to (12) need of neighbouring path points.

    edges_mm: Ascending edges of the bins; pairs at an edge count above it.
    rows: Measured positions to pair.

    Raises InputError: there are no two measured positions, or fewer than two edges.
    """
    chosen = np.asarray(rows, dtype=np.int64)
    edges = np.asarray(edges_mm, dtype=np.float64)
    if len(chosen) < 2 or len(edges) < 2 or (np.diff(edges) <= 0).any():
        raise InputError("a correlation over distance needs two measured positions and ascending edges")
    reader = RowReader(bank)
    unit = np.stack([_unit(reader.read(int(row))) for row in chosen])
    position_mm = np.asarray(bank.position_mm, dtype=np.float64)[chosen]
    first, second = np.triu_indices(len(chosen), 1)
    apart_mm = np.hypot(*(position_mm[first] - position_mm[second]).T)
    gram = np.stack([unit[:, actuator] @ unit[:, actuator].T for actuator in range(bank.actuators)])
    coefficient = gram[:, first, second]
    bins = np.digitize(apart_mm, edges) - 1
    columns: list[list[float]] = []
    for number in range(len(edges) - 1):
        here = bins == number
        known = coefficient[:, here].ravel()
        known = known[np.isfinite(known)]
        if known.size:
            low, high = np.quantile(known, [0.1, 0.9])
            columns.append([apart_mm[here].mean(), known.mean(), low, high])
    if not columns:
        raise InputError(f"no two positions are between {edges[0]:g} and {edges[-1]:g} mm apart")
    return DistanceCorrelation(*np.array(columns).T)


def _unit(green: Float64Array) -> Float64Array:
    """Each actuator's Green's function over its norm, NaN for one that is silent."""
    norm = np.linalg.norm(green, axis=1, keepdims=True)
    return np.asarray(np.divide(green, norm, out=np.full_like(green, np.nan), where=norm > 0))


IMPULSE_BAND_HZ = (50.0, 450.0)
"""The paper's band of impulses."""
SPAN_MM = (20.0, 100.0)
MIN_PAIRS = 20


@dataclass(frozen=True, slots=True)
class ImpulseTravel:
    """Travel of band-limited impulses.

    group_velocity_m_s: Inverse slope of the energy's mean arrival over distance.
    attenuation_db_per_cm: Loss of energy per distance, spreading removed; positive where waves die away.
    velocity_error_m_s, attenuation_error_db_per_cm: Standard errors of the two figures.
    correlation: Of arrivals and distances, means of each actuator removed; -1 to 1.
    """

    group_velocity_m_s: float
    attenuation_db_per_cm: float
    velocity_error_m_s: float
    attenuation_error_db_per_cm: float
    correlation: float

    @property
    def is_sure(self) -> bool:
        """Arrivals follow distances well enough for a velocity; in a room they do not."""
        return self.correlation >= 0.7 and 3.0 * self.velocity_error_m_s <= self.group_velocity_m_s


def impulse_travel(
    bank: GreenSource,
    band_hz: tuple[float, float] | None = IMPULSE_BAND_HZ,
    span_mm: tuple[float, float] = SPAN_MM,
    rows: Sequence[int] | None = None,
) -> ImpulseTravel:
    """Fit group velocity and attenuation to the bank's Green's functions.

    Each Green's function is limited to the band, which makes it the response to a band-limited impulse. Its
    arrival is the centroid of its energy, ``sum t g^2 / sum g^2``; its level is ``10 lg(r sum g^2)``, the
    distance r taking away the spreading of a wave on a surface. Arrival and level over distance are each
    fitted by a straight line, for each actuator with an offset of its own.

    band_hz: Band of the impulse; None: the Green's functions as they are.
    span_mm: Distances that are used, above 0.
    rows: Rows to choose from; by default all usable ones.

    Raises InputError: too few pairs of a measured position and an actuator of known place are that far apart.
    """
    allowed = np.flatnonzero(usable(bank)) if rows is None else np.asarray(rows, dtype=np.int64)
    allowed = allowed[evenly_spread(len(allowed), 96)]
    actuator_mm = np.asarray(bank.actuator_mm, dtype=np.float64)
    distance, arrival, level, actuator = ([] for _ in range(4))
    time_s, reader = np.arange(bank.taps) / bank.sample_rate_hz, RowReader(bank)
    for row in allowed.tolist():
        apart_mm = np.hypot(*(actuator_mm - np.asarray(bank.position_mm)[row]).T)
        near = np.flatnonzero((apart_mm >= span_mm[0]) & (apart_mm <= span_mm[1]))
        if not len(near):
            continue
        green = reader.read(row)[near]
        energy = np.square(green if band_hz is None else band_limited(green, bank.sample_rate_hz, band_hz))
        total = energy.sum(axis=1)
        driven = total > 0
        distance.append(apart_mm[near][driven])
        arrival.append((energy[driven] @ time_s) / total[driven])
        level.append(10.0 * np.log10(apart_mm[near][driven] * total[driven]))
        actuator.append(near[driven])
    pairs = sum(map(len, distance))
    if pairs < MIN_PAIRS:
        raise InputError(
            f"only {pairs} pairs of a measured position and an actuator of known place lie {span_mm[0]:g} to"
            f" {span_mm[1]:g} mm apart; at least {MIN_PAIRS} are needed for a velocity"
        )
    of = np.concatenate(actuator)
    slope, doubt, correlation = _fit(np.concatenate(distance), np.concatenate(arrival), of)
    fall, fall_doubt, _ = _fit(np.concatenate(distance), np.concatenate(level), of)
    velocity = 1e-3 / slope if slope else np.inf
    error = abs(velocity * doubt / slope) if slope else np.inf
    return ImpulseTravel(velocity, -10.0 * fall, error, 10.0 * fall_doubt, correlation)


def _fit(distance_mm: Float64Array, value: Float64Array, actuator: Int64Array) -> tuple[float, float, float]:
    """Common slope of straight lines with an offset per actuator, its standard error, and the correlation.

    The standard error is the larger one of least squares and of leaving out one actuator at a time.
    """
    _, group = np.unique(actuator, return_inverse=True)
    count = np.bincount(group)
    x = distance_mm - (np.bincount(group, distance_mm) / count)[group]
    y = value - (np.bincount(group, value) / count)[group]
    slope = float(x @ y) / float(x @ x)
    left = y - slope * x
    doubt = float(np.sqrt(left @ left / max(1, len(x) - len(count) - 1) / (x @ x)))
    # What one actuator's waves meet is alike at neighbouring positions, so that pairs are no independent samples.
    xy, xx = np.bincount(group, x * y), np.bincount(group, x * x)
    if len(count) > 2 and (xx.sum() - xx > 0).all():
        without = (xy.sum() - xy) / (xx.sum() - xx)
        jackknife = (len(count) - 1) / len(count) * np.sum(np.square(without - without.mean()))
        doubt = max(doubt, float(np.sqrt(jackknife)))
    power = float(np.sqrt((x @ x) * (y @ y)))
    return slope, doubt, float(x @ y) / power if power else 0.0


RESOLUTION_HZ = 5.0


@dataclass(frozen=True, slots=True)
class PathSpectrum:
    """Magnitudes (points, bins) of the Fourier transform at path points, in the responses' unit times seconds."""

    frequency_hz: Float64Array
    magnitude: Float64Array

    @property
    def mean(self) -> Float64Array:
        """Mean over the points, (bins,): the paper's "average magnitude spectrum"."""
        return np.asarray(self.magnitude.mean(axis=0))

    @property
    def centroid_hz(self) -> float:
        """Mean frequency of the energy of all points; NaN without any."""
        return self._mean_of(self.frequency_hz)

    def share_within(self, band_hz: tuple[float, float]) -> float:
        """Share of the energy of all points that lies within a band, 0 to 1; NaN without any energy."""
        return self._mean_of((self.frequency_hz >= band_hz[0]) & (self.frequency_hz <= band_hz[1]))

    def _mean_of(self, values: NDArray[Any]) -> float:
        """Mean of values of the bins, weighted by the energy of all points."""
        energy = np.square(self.magnitude).sum(axis=0)
        total = float(energy.sum())
        return float(energy @ values) / total if total > 0 else float("nan")


def path_spectrum(
    responses: NDArray[np.floating[Any]], sample_rate_hz: float, first_sample: Int64Array, samples: int
) -> PathSpectrum:
    """Transform each point's response over a window of its own.

    responses, float (points, samples of the field): Of at least one point.
    first_sample, int64 (points,): Begin of each window; outside the field there is silence.
    samples: Length of the windows, >= 1; rectangular. Zeros are appended for bins at most `RESOLUTION_HZ` apart.
    """
    windows = np.zeros((len(responses), samples))
    for window, response, first in zip(windows, responses, first_sample.tolist(), strict=True):
        begin, end = max(first, 0), min(first + samples, len(response))
        if end > begin:
            window[begin - first : end - first] = response[begin:end]
    length = fast_length(max(samples, int(np.ceil(sample_rate_hz / RESOLUTION_HZ))))
    magnitude = np.abs(np.fft.rfft(windows, length, axis=1)) / sample_rate_hz
    return PathSpectrum(np.fft.rfftfreq(length, 1.0 / sample_rate_hz).astype(np.float64), magnitude)


@dataclass(frozen=True, slots=True)
class CrosstalkTable:
    """Crosstalk over speed, (speeds,), and path sample distance d, (steps,).

    `energy_ratio`, (speeds, steps): Energy of all other points' foci at a point over that of its own, see
    `_energy_ratio`; NaN where the path has fewer than two points.
    """

    speed_mm_s: Float64Array
    step_mm: Float64Array
    energy_ratio: Float64Array


def path_responses(
    bank: GreenSource, rows: Sequence[int], regularisation: Regularisation | None = None
) -> Float64Array:
    """Response at each of some rows to the focus of an impulse at each of them, float64 (rows, rows, samples).

    A focus emits its impulse at sample L - 1, L the bank's taps. With normalisation a response is in the source's unit,
    without it in the square of the bank's.

    rows: Rows of the path's points, at most some dozens.
    regularisation: Saturation and normalisation; by default normalised, without saturation.

    Raises InputError: a row is not measured, or the responses do not fit into memory.
    """
    regularisation = regularisation or Regularisation()
    length = fast_length(2 * bank.taps - 1)
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
    # Lags from -(taps - 1) on.
    responses *= keep[bins] * np.exp(-2j * np.pi * bins * (bank.taps - 1) / length)
    whole = np.zeros((len(rows), len(rows), length // 2 + 1), dtype=np.complex128)
    whole[..., bins] = responses
    return np.fft.irfft(whole, length, axis=2)


def _energy_ratio(values: Float64Array, instants: Int64Array, lead: int) -> float:
    """Crosstalk ratio of a source that moves from point to point; NaN with fewer than two points.

    Point m emits an impulse at sample n_m of `instants`, (points + 1,). Over a window as long as the impulses are
    apart, about that of point m (a focus converges as long as it diverges), the energy that all other points' foci
    together cause at point m is divided by that of its own focus; energies are summed over the points before they are
    divided. The paper (section IV.C) names the ratio of these energies and no window.

    values, (points, points, samples): As `path_responses` gives them, a focus emitting from sample `lead` on.
    """
    points, length = values.shape[0], values.shape[2]
    if points < 2:
        return float("nan")
    own_energy = others_energy = 0.0
    for m in range(points):
        period = max(int(instants[m + 1] - instants[m]), 1)
        window = instants[m] + (1 - period) // 2 + np.arange(period)
        own, others = np.zeros((2, period))
        for other in range(points):
            lag = window - instants[other] + lead
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
    regularisation: Regularisation | None = None,
) -> CrosstalkTable:
    """Crosstalk along one line of `rows` that are `row_step_mm` apart, over speeds v and path sample distances d.

    The latter are `every`, in steps of the rows; point m emits at ``round(m d / v rate)``. For
    `regularisation` see `path_responses`.
    """
    values = path_responses(bank, rows, regularisation)
    speeds, steps = np.asarray(speeds_mm_s, dtype=np.float64), row_step_mm * np.asarray(every, dtype=np.float64)
    ratio = np.empty((len(speeds), len(steps)))
    for (row, column), _ in np.ndenumerate(ratio):
        own = values[:: every[column], :: every[column]]
        instants = np.arange(len(own) + 1) * steps[column] / speeds[row] * float(bank.sample_rate_hz)
        ratio[row, column] = _energy_ratio(own, np.rint(instants).astype(np.int64), bank.taps - 1)
    return CrosstalkTable(speeds, steps, ratio)
