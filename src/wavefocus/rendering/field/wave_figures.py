"""Waves in a bank and in responses: correlation over distance, travel of impulses, spectra at path points."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.device import fast_length
from wavefocus.rendering.field.metrics import band_limited
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
        energy = np.square(self.magnitude).sum(axis=0)
        total = float(energy.sum())
        return float(energy @ self.frequency_hz) / total if total > 0 else float("nan")

    def share_within(self, band_hz: tuple[float, float]) -> float:
        """Share of the energy of all points that lies within a band, 0 to 1; NaN without any energy."""
        energy = np.square(self.magnitude).sum(axis=0)
        inside = (self.frequency_hz >= band_hz[0]) & (self.frequency_hz <= band_hz[1])
        total = float(energy.sum())
        return float(energy[inside].sum()) / total if total > 0 else float("nan")


def path_spectrum(
    responses: NDArray[np.floating[Any]], sample_rate_hz: float, first_sample: Int64Array, samples: int
) -> PathSpectrum:
    """Transform each point's response over a window of its own.

    responses, float (points, samples of the field).
    first_sample, int64 (points,): Begin of each window; outside the field there is silence.
    samples: Length of the windows, >= 1; rectangular. Zeros are appended for bins at most `RESOLUTION_HZ` apart.

    Raises InputError: there is no point, or a figure is out of range.
    """
    if responses.ndim != 2 or not len(responses) or len(first_sample) != len(responses):
        raise InputError(f"responses of shape {responses.shape} do not go with {len(first_sample)} windows")
    if samples < 1 or not sample_rate_hz > 0:
        raise InputError(f"a window of {samples} samples at {sample_rate_hz} Hz has no spectrum")
    windows = np.zeros((len(responses), samples))
    for window, response, first in zip(windows, responses, first_sample.tolist(), strict=True):
        begin, end = max(first, 0), min(first + samples, len(response))
        if end > begin:
            window[begin - first : end - first] = response[begin:end]
    length = fast_length(max(samples, int(np.ceil(sample_rate_hz / RESOLUTION_HZ))))
    magnitude = np.abs(np.fft.rfft(windows, length, axis=1)) / sample_rate_hz
    return PathSpectrum(np.fft.rfftfreq(length, 1.0 / sample_rate_hz).astype(np.float64), magnitude)
