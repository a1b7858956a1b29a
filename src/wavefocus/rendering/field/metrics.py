"""Figures of wave fields on a grid of positions, each with its definition."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import Float32Array, Float64Array
from wavefocus.rendering.device import fast_length
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.storage.errors import InputError

RealArray = NDArray[np.floating[Any]]
Place = tuple[float, float] | Float64Array
"""A point on the surface, x and y in millimetres."""

# Cells per grid spacing on which a focal spot is drawn: area to about 1 % at 8 mm width on 4 mm.
CELLS_PER_SPACING = 8


@dataclass(frozen=True, slots=True)
class FocusPeak:
    """Peak of a field: grid position `row`, place of the peak between positions, field at `row` with its sign."""

    row: int
    at_mm: tuple[float, float]
    value: float


def normalised_error(measured: RealArray, predicted: RealArray) -> float:
    """Relative L2 error ``||measured - predicted|| / ||measured||`` over all elements, of any equal shape and unit.

    0 for equal fields; infinite when `measured` is zero and `predicted` is not. Raises InputError: the shapes differ.
    """
    _same_shape(measured, predicted)
    error = float(np.linalg.norm((measured - predicted).astype(np.float64).ravel()))
    norm = float(np.linalg.norm(measured.astype(np.float64).ravel()))
    return error / norm if norm > 0.0 else (0.0 if error == 0.0 else math.inf)


def correlation(first: RealArray, second: RealArray) -> float:
    """Zero-lag correlation ``<a, b> / (||a|| ||b||)`` over all elements, means not removed; NaN when either is zero."""
    _same_shape(first, second)
    a, b = first.astype(np.float64).ravel(), second.astype(np.float64).ravel()
    norm = float(np.linalg.norm(a)) * float(np.linalg.norm(b))
    return float(a @ b) / norm if norm > 0.0 else math.nan


def level_db(ratio: float) -> float:
    """Amplitude ratio in decibels, ``20 lg ratio``; minus infinity for 0, NaN stays NaN."""
    return 20.0 * math.log10(ratio) if ratio > 0.0 else (-math.inf if ratio == 0.0 else math.nan)


def range_db(amplitude: RealArray) -> float:
    """Range ``20 lg(largest / smallest)`` of positive amplitudes, such as n(x) of equation (15).

    Elements that are not finite or not positive (positions not measured) are left out;
    NaN when fewer than two remain.
    """
    usable = amplitude[np.isfinite(amplitude) & (amplitude > 0.0)]
    return level_db(float(usable.max()) / float(usable.min())) if usable.size > 1 else math.nan


def gain_range_db(gain: RealArray, position_mm: Float64Array, actuator_mm: Float64Array, clear_mm: float) -> float:
    """Range of n(x), or of its inverse, over the positions further than `clear_mm` from every actuator.

    The paper (section IV.A) says up to 17 dB and not where: next to an actuator n(x) falls without end. `gain` is NaN
    where not measured, `actuator_mm` where unknown.
    """
    known = actuator_mm[np.isfinite(actuator_mm).all(axis=1)]
    if not len(known):
        return range_db(gain)
    distance = np.hypot(*(position_mm[:, None] - known).transpose(2, 0, 1)).min(axis=1)
    return range_db(gain[distance > clear_mm])


def grid_spacing_mm(position_mm: Float64Array) -> float:
    """Median distance from each position to its nearest neighbour, or root mean square of a rectangular grid's pitches.

    Raises InputError: fewer than two positions.
    """
    if len(position_mm) < 2:
        raise InputError(f"a grid spacing needs two positions, there are {len(position_mm)}")
    grid = PositionGrid(position_mm)
    lattice, spacing_mm = grid.lattice, grid.spacing_mm
    # On the lattice of a hexagonal grid, neighbours are not next to each other; a line has one pitch.
    if lattice is None or min(lattice.row_at.shape) == 1 or spacing_mm != lattice.pitch_mm.min():
        return spacing_mm
    return math.hypot(*lattice.pitch_mm) / math.sqrt(2.0)


def focus_peak(
    position_mm: Float64Array, field: RealArray, near_mm: Place, radius_mm: float, spacing_mm: float | None = None
) -> FocusPeak | None:
    """Find the place of the largest ``|field|`` within `radius_mm` of a point.

    The largest grid position is refined by the vertex of a quadratic surface fitted (least
    squares) to the logarithm of it and its neighbours within 1.5 spacings that have its sign
    and a twentieth of its magnitude: exact for a Gaussian spot, and to 0.3 mm for a
    jinc spot of 8 mm on a grid of 4 mm. With fewer than six such neighbours the field
    itself is fitted; the grid position counts where that has no maximum within one spacing.

    field, (positions,): The field at one instant, any unit.
    near_mm: Intended place of the focus.
    spacing_mm: Spacing of the grid; the largest position's nearest neighbour counts where it is further, or without it.

    Returns None when no position lies within the radius.
    """
    rows = np.flatnonzero(np.hypot(*(position_mm - np.asarray(near_mm)).T) <= radius_mm)
    if not rows.size:
        return None
    row = int(rows[np.argmax(np.abs(field[rows]))])
    value, centre = float(field[row]), position_mm[row]
    offset = position_mm - centre
    distance = np.hypot(*offset.T)
    at = centre
    others = distance[distance > 0.0]
    if others.size and value != 0.0:
        spacing = max(float(others.min()), spacing_mm or 0.0)
        near = distance <= 1.5 * spacing
        relative = field.astype(np.float64) / value
        # Neighbours of a peak below this part of it belong to its skirt and not to its lobe.
        lobe = near & (relative > 0.05)
        vertex = _quadratic_vertex(offset[lobe] / spacing, np.log(relative[lobe]))
        if vertex is None:
            vertex = _quadratic_vertex(offset[near] / spacing, relative[near])
        if vertex is not None:
            at = centre + spacing * vertex
    return FocusPeak(row=row, at_mm=(float(at[0]), float(at[1])), value=value)


def focal_width_mm(position_mm: Float64Array, field: RealArray, peak_row: int, spacing_mm: float) -> float | None:
    """Full width at half maximum of a focal spot: the diameter of a disk of equal area.

    The field within five spacings of the peak is interpolated (quintic radial basis
    functions) on cells of an eighth of a spacing. The spot is the connected region around
    the peak in which the field has the peak's sign and more than half of its value;
    the width is ``sqrt(4 area / pi)``.

    `peak_row` is the position with the largest magnitude. Returns None when the spot reaches beyond the positions.
    """
    from scipy import ndimage, spatial
    from scipy.interpolate import RBFInterpolator  # a render measures no spot, and does not wait for these

    value = float(field[peak_row])
    reach = 5.0 * spacing_mm  # so far around its peak a focal spot is drawn
    offset = position_mm - position_mm[peak_row]
    near = np.hypot(*offset.T) <= reach + spacing_mm
    if np.count_nonzero(near) < 9 or value == 0.0 or not np.all(np.isfinite(field[near])):
        return None
    cell = spacing_mm / CELLS_PER_SPACING
    half_cells = round(reach / cell)
    axis = np.arange(-half_cells, half_cells + 1) * cell
    cells = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    gap, _ = spatial.cKDTree(offset[near]).query(cells)
    # Any point of a full rectangular grid lies within 0.71 spacings of a position.
    known = (gap <= 0.75 * spacing_mm) & (np.hypot(*cells.T) <= reach)
    try:
        surface = RBFInterpolator(offset[near], field[near].astype(np.float64) / value, kernel="quintic")
    except np.linalg.LinAlgError:  # positions on one line have a width along it only
        return None
    spot = np.zeros(len(cells))
    spot[known] = surface(cells[known])
    shape = (axis.size, axis.size)
    spot = spot.reshape(shape)
    middle = slice(half_cells - CELLS_PER_SPACING, half_cells + CELLS_PER_SPACING + 1)
    highest = float(spot[middle, middle].max())
    labels, _ = ndimage.label(spot > 0.5 * highest)
    region = labels == labels[half_cells, half_cells]
    if labels[half_cells, half_cells] == 0 or np.any(ndimage.binary_dilation(region) & ~known.reshape(shape)):
        return None
    return math.sqrt(4.0 * float(np.count_nonzero(region)) * cell**2 / math.pi)


def artefact_level_db(position_mm: Float64Array, field: RealArray, near_mm: Place, radius_mm: float) -> float:
    """Largest ``|field|`` further than `radius_mm` from a focus over the largest within it, in dB.

    NaN when there is no position on either side of the circle, or no field within.
    """
    within = np.hypot(*(position_mm - np.asarray(near_mm)).T) <= radius_mm
    if within.all() or not within.any():
        return math.nan
    inside = float(np.max(np.abs(field[within])))
    return level_db(float(np.max(np.abs(field[~within]))) / inside) if inside > 0.0 else math.nan


@dataclass(frozen=True, slots=True)
class FocusSpot:
    """Figures of one focus, as `focus_peak`, `focal_width_mm` and `artefact_level_db` define them; NaN: has none.

    `off_mm` is the distance of the peak from the intended place.
    """

    value: float
    at_mm: tuple[float, float]
    off_mm: float
    width_mm: float
    artefact_db: float


def focus_spot(
    position_mm: Float64Array,
    field: RealArray,
    near_mm: Place,
    radius_mm: float,
    spacing_mm: float | None,
) -> FocusSpot | None:
    """All figures of the focus near a point; None where no position lies within the radius."""
    peak = focus_peak(position_mm, field, near_mm, radius_mm, spacing_mm)
    if peak is None:
        return None
    width = None if spacing_mm is None else focal_width_mm(position_mm, field, peak.row, spacing_mm)
    return FocusSpot(
        value=peak.value,
        at_mm=peak.at_mm,
        off_mm=math.hypot(peak.at_mm[0] - near_mm[0], peak.at_mm[1] - near_mm[1]),
        width_mm=math.nan if width is None else width,
        artefact_db=artefact_level_db(position_mm, field, near_mm, radius_mm),
    )


def band_weights(samples: int, sample_rate_hz: float, band_hz: tuple[float, float]) -> Float32Array:
    """Zero-phase weights of a band on the bins of ``rfft``, shape (samples // 2 + 1,).

    1 inside `band_hz`, falling to 0 over a quarter of an octave outside it, as half a cosine on the logarithm of
    frequency. A band from 0 Hz has no lower edge.
    """
    frequency = np.maximum(np.fft.rfftfreq(samples, 1.0 / sample_rate_hz), 1e-9)
    outside = np.maximum(np.log2(max(band_hz[0], 1e-9) / frequency), np.log2(frequency / band_hz[1]))
    return np.asarray(0.5 + 0.5 * np.cos(np.pi * np.clip(outside / 0.25, 0.0, 1.0)), dtype=np.float32)


def band_limited(field: RealArray, sample_rate_hz: float, band_hz: tuple[float, float]) -> RealArray:
    """The part of signals (..., samples) within a band, by `band_weights` on their zero-padded spectra."""
    samples = field.shape[-1]
    padded = fast_length(samples + round(2.0 * sample_rate_hz / (band_hz[0] or band_hz[1])))
    spectrum = np.fft.rfft(field, padded)
    spectrum *= band_weights(padded, sample_rate_hz, band_hz)
    limited: RealArray = np.fft.irfft(spectrum, padded)[..., :samples].astype(field.dtype, copy=False)
    return limited


def _quadratic_vertex(offset: Float64Array, value: Float64Array) -> Float64Array | None:
    """Vertex of a quadratic surface through values around the origin, None without a maximum nearby."""
    x, y = offset.T
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    if len(terms) < 6 or np.linalg.matrix_rank(terms) < 6:
        return None
    _, bx, by, cxx, cxy, cyy = np.linalg.lstsq(terms, value, rcond=None)[0]
    hessian = np.array([[2.0 * cxx, cxy], [cxy, 2.0 * cyy]])
    if cxx >= 0.0 or np.linalg.det(hessian) <= 0.0:
        return None
    vertex: Float64Array = -np.linalg.solve(hessian, np.array([bx, by]))
    return vertex if float(np.hypot(*vertex)) <= 1.0 else None


def _same_shape(first: RealArray, second: RealArray) -> None:
    if first.shape != second.shape:
        raise InputError(f"fields to compare must have one shape, not {first.shape} and {second.shape}")
