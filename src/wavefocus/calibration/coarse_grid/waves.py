"""Waves in the plane of the plate, the ring of sources around it, and the wave number over frequency.

Time as exp(+j w t): an outgoing wave is the Hankel function of the second kind, and the wave number k has Im k <= 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize
from scipy.sparse import csr_array
from scipy.spatial import ConvexHull, cKDTree
from scipy.special import hankel2

from wavefocus.calibration import Complex64Array, Complex128Array, Float64Array

_MIN_DISTANCE_MM = 1.0
"""Actuators have a radius: no point is nearer to one."""
_ENVELOPE_NODES = 120
"""Nodes of the spline of a Hankel function's envelope; it is right to 1e-6 from 1 to 300 mm."""
_HULL_DIRECTIONS = 48


def grid_spacing_mm(position_mm: Float64Array) -> float:
    """Median distance of neighbouring positions."""
    return float(np.median(np.asarray(cKDTree(position_mm).query(position_mm, k=2)[0])[:, 1]))


def distances_mm(points_mm: Float64Array, others_mm: Float64Array) -> Float64Array:
    """Distances (points, others), at least `_MIN_DISTANCE_MM`."""
    gap_mm = points_mm[:, None] - others_mm[None]
    return np.asarray(np.maximum(np.hypot(gap_mm[..., 0], gap_mm[..., 1]), _MIN_DISTANCE_MM))


def outgoing(wavenumber: complex, distance_mm: Float64Array) -> Complex128Array:
    """H0(2)(k r) at many distances, see `outgoing_each`."""
    return np.asarray(outgoing_each([(wavenumber, 0)], distance_mm)[0])


def outgoing_each(waves: Sequence[tuple[complex, int]], distance_mm: Float64Array) -> Complex128Array:
    """H(2)(k r) of several wave numbers and orders, (waves, *distances).

    At many distances from splines of the envelopes ``H exp(j k r) sqrt(r)`` over log r, all with the same nodes.

    Raises LinAlgError: a wave is too large for any number, as of a law that fits few frequencies by chance.
    """
    wavenumber = np.array([k for k, _ in waves], dtype=np.complex128)
    order = np.array([order for _, order in waves])
    each = (slice(None), *(None for _ in distance_mm.shape))
    if distance_mm.size <= 4 * _ENVELOPE_NODES:
        return np.asarray(hankel2(order[each], wavenumber[each] * distance_mm))
    nodes_mm = np.geomspace(distance_mm.min() * 0.999, distance_mm.max() * 1.001, _ENVELOPE_NODES)
    k = wavenumber[:, None]
    envelope = hankel2(order[:, None], k * nodes_mm) * np.exp(1j * k * nodes_mm) * np.sqrt(nodes_mm)
    if not np.isfinite(envelope).all():
        raise np.linalg.LinAlgError("a wave number makes waves beyond all numbers")
    found = CubicSpline(np.log(nodes_mm), envelope, axis=1)(np.log(distance_mm))
    different, same = np.unique(wavenumber, return_inverse=True)
    found *= np.exp(-1j * different[each] * distance_mm)[same]
    found /= np.sqrt(distance_mm)
    return np.asarray(found)


_TABLE_STEP_RAD = 0.15
"""Step of a table of H0(2) in radians of the shortest wave; cubics between its nodes are right to 1e-5."""
_TABLE_STEP_SHARE = 0.1
"""Step at most, in shares of the least distance: towards 0 H0(2) is a logarithm, however long the waves."""
_SMEARED = (0.3, 0.6, 0.85, 1.1, 1.2, 1.3)
"""Of the wave number: waves of other frequencies, which a bank's first tap, cutting off what comes before, mixes in."""


def outgoing_at_all(wavenumbers: Complex128Array, distance_mm: Float64Array) -> Complex64Array:
    """H0(2)(k r) at many distances (n, m), for many wave numbers (frequencies,): (frequencies, n, m).

    All are interpolated from tables over r with the same weights, which is a product with one sparse matrix.
    """
    low_mm, high_mm = float(distance_mm.min()), float(distance_mm.max())
    step_mm = min(_TABLE_STEP_RAD / float(np.abs(wavenumbers).max()), _TABLE_STEP_SHARE * low_mm)
    nodes_mm = low_mm + step_mm * np.arange(-1, int((high_mm - low_mm) / step_mm) + 4)
    nodes_mm = np.maximum(nodes_mm, 1e-3 * step_mm)
    waves = [(k, 0) for k in wavenumbers.tolist()]
    if distance_mm.size < 2 * len(nodes_mm):
        return outgoing_each(waves, distance_mm).astype(np.complex64)
    table = outgoing_each(waves, nodes_mm).T.astype(np.complex64)
    at = (distance_mm.ravel() - low_mm) / step_mm + 1.0
    cell = at.astype(np.int32)
    t = at - cell
    before, at_or_before = -t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2
    weights = [before, at_or_before, -(t + 1) * t * (t - 2) / 2, (t + 1) * t * (t - 1) / 6]
    rows = 4 * np.arange(len(at) + 1, dtype=np.int32)
    columns = (cell[:, None] + np.arange(-1, 3, dtype=np.int32)).ravel()
    values = np.stack(weights, axis=1).ravel().astype(np.complex64)
    found = csr_array((values, columns, rows), shape=(len(at), len(nodes_mm))) @ table
    return np.ascontiguousarray(found.T).reshape(-1, *distance_mm.shape)


def waves_of_actuators(
    wavenumbers: Sequence[complex],
    pressure_share: float,
    points_mm: Float64Array,
    actuator_mm: Float64Array,
    others: Sequence[float] = _SMEARED,
) -> Complex128Array:
    """Waves that each actuator sends out, then those of other frequencies, (wave numbers, waves, points, actuators).

    Green's functions are zero before their first tap, and limited to a band. Near an actuator the band-limited pulse
    begins earlier than that and is cut, which mixes frequencies, by some percent at the band's upper end.

    pressure_share: 0 for one scalar wave per actuator, as of a force across a plate or membrane. Above 0 for a force in
        the plane of a solid: shear waves of wave number k and pressure waves of k times this share, each of orders 0
        and 2 (the derivatives of H0 that make up Green's tensor of a solid).
    others: Wave numbers of the waves of other frequencies, over k.
    """
    if pressure_share:
        return _waves_of_a_solid(wavenumbers, (1.0, pressure_share, *others), points_mm, actuator_mm)
    waves = [(share * k, 0) for k in wavenumbers for share in (1.0, *others)]
    found = outgoing_each(waves, distances_mm(points_mm, actuator_mm))
    return found.reshape(len(wavenumbers), -1, *found.shape[1:])


def waves_of_actuators_at_all(
    wavenumbers: Complex128Array, pressure_share: float, points_mm: Float64Array, actuator_mm: Float64Array
) -> Complex64Array:
    """`waves_of_actuators` for many wave numbers: (frequencies, waves, points, actuators)."""
    if pressure_share:
        each = (waves_of_actuators([k], pressure_share, points_mm, actuator_mm)[0] for k in wavenumbers.tolist())
        return np.stack([waves.astype(np.complex64) for waves in each])
    shares = np.array([1.0, *_SMEARED])
    found = outgoing_at_all((wavenumbers[:, None] * shares).ravel(), distances_mm(points_mm, actuator_mm))
    return found.reshape(len(wavenumbers), len(shares), len(points_mm), len(actuator_mm))


def _waves_of_a_solid(
    wavenumbers: Sequence[complex], shares: Sequence[float], points_mm: Float64Array, actuator_mm: Float64Array
) -> Complex128Array:
    """Waves of a solid, (wave numbers, waves, points, actuators): of orders 0 and 2 at shares of each wave number."""
    gap_mm = points_mm[:, None] - actuator_mm[None]
    turn = np.exp(2j * np.arctan2(gap_mm[..., 1], gap_mm[..., 0]))
    waves = [(share * k, order) for k in wavenumbers for share in shares for order in (0, 2)]
    found = outgoing_each(waves, distances_mm(points_mm, actuator_mm)).reshape(-1, 2, *turn.shape)
    zeroth, second = found[:, 0], found[:, 1]
    each = np.stack([zeroth, second * turn.real, second * turn.imag], axis=1)
    return each.reshape(len(wavenumbers), -1, *turn.shape)


def rim_ring(points_mm: Float64Array, offset_mm: float, spacing_mm: float) -> Float64Array:
    """Points (n, 2) along the convex hull of all points, moved outwards by an offset, about a spacing apart."""
    turn = np.exp(2j * np.pi * np.arange(_HULL_DIRECTIONS) / _HULL_DIRECTIONS)
    circle_mm = offset_mm * np.stack([turn.real, turn.imag], axis=1)
    wide_mm = (points_mm[:, None] + circle_mm).reshape(-1, 2)
    corner = ConvexHull(wide_mm).vertices
    closed_mm = wide_mm[np.append(corner, corner[0])]
    arc_mm = np.append(0.0, np.cumsum(np.hypot(*np.diff(closed_mm, axis=0).T)))
    along_mm = np.linspace(0.0, arc_mm[-1], int(arc_mm[-1] / spacing_mm) + 2)[1:]
    return np.stack([np.interp(along_mm, arc_mm, closed_mm[:, axis]) for axis in (0, 1)], axis=1)


@dataclass(frozen=True, slots=True)
class Dispersion:
    """Wave number over frequency: ``k^2 = (w/w0)^(-2m) (w^2 - j w b (w/w0)^q) / c^2``.

    middle_hz: w0 over two pi.
    speed_mm_s: c.
    loss_per_s: b, >= 0.
    slope: m; 0 where waves of all frequencies are equally fast, 1/2 for bending waves.
    loss_slope: q.
    """

    middle_hz: float
    speed_mm_s: float
    loss_per_s: float
    slope: float = 0.0
    loss_slope: float = 0.0

    def wavenumber(self, frequency_hz: Float64Array) -> Complex128Array:
        """Wave numbers in rad/mm."""
        omega = 2.0 * np.pi * np.asarray(frequency_hz, dtype=np.float64)
        ratio = np.asarray(frequency_hz) / self.middle_hz
        damped = np.sqrt(omega**2 - 1j * omega * self.loss_per_s * ratio**self.loss_slope)
        return np.asarray(ratio**-self.slope * damped / self.speed_mm_s)

    @property
    def vector(self) -> Float64Array:
        """What is fitted: (log c, log b, m, q)."""
        return np.array([np.log(self.speed_mm_s), np.log(self.loss_per_s), self.slope, self.loss_slope])

    @classmethod
    def _of_vector(cls, vector: Float64Array, middle_hz: float) -> Dispersion:
        """From what is fitted."""
        log_c, log_b, slope, loss_slope = vector.tolist()
        return cls(
            middle_hz, float(np.exp(np.clip(log_c, -30, 60))), float(np.exp(np.clip(log_b, -30, 60))), slope, loss_slope
        )

    def fitted_to(self, frequency_hz: Float64Array, wavenumber: Complex128Array) -> Dispersion:
        """The law nearest to some wave numbers, relative to them, by least squares."""

        def misfit(vector: Float64Array) -> float:
            law = Dispersion._of_vector(vector, self.middle_hz).wavenumber(frequency_hz)
            return float(1e4 * np.square(np.abs(law / wavenumber - 1.0)).sum())

        return Dispersion._of_vector(_simplex(misfit, self.vector, [0.01, 0.2, 0.05, 0.1], 2000), self.middle_hz)


_SCANNED_SPEEDS = 160
_SCANNED_SLOPES = (0.0, 0.5)
MIN_WAVELENGTH_SPACINGS, MAX_WAVELENGTH_SIZES = 0.4, 12.0
"""Wavelengths looked for at the highest frequency, in grid spacings and in sizes of the surface."""
_PRESSURE_SHARE = 0.5
"""Pressure over shear wave number of a solid, where the search starts."""
_ELASTIC_SPEEDS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.25, 1.5)
"""Speeds of shear waves over that of the scalar waves, from which the search starts."""
_MAX_LOSS = 0.5
"""Im k over |k| at the highest frequency: what fades faster is no wave, and explains a few positions by chance."""
_SCANNED_LOSS = 0.25
"""Loss b of the first scan over w0: waves that fade a little, as all do."""


def dispersion_of_own_waves(
    frequency_hz: Float64Array,
    points_mm: Float64Array,
    actuator_mm: Float64Array,
    transfer: Complex128Array,
    spacing_mm: float,
    elastic_near: Dispersion | None = None,
) -> tuple[Dispersion, float, float]:
    """Find the waves that explain most of the transfer functions (frequencies, points, actuators), coarsely.

    Each actuator's own waves are fitted by least squares at each frequency; there are no others.

    elastic_near: Law of the scalar waves, near which the waves of a solid are looked for; by default waves are scalar.

    Returns the law, the share of wave numbers of the second wave, and the share of the energy that is left unexplained.
    """
    middle_hz = float(np.sqrt(frequency_hz[0] * frequency_hz[-1]))
    pressure_share = 0.0 if elastic_near is None else _PRESSURE_SHARE
    values = transfer.transpose(0, 2, 1)
    energy = np.square(np.abs(values)).sum()
    weight = 1.0 / np.maximum(np.square(np.abs(values)).sum(axis=(1, 2)), 1e-300)

    def left(vector: Float64Array) -> float:
        wavenumber = Dispersion._of_vector(vector[:4], middle_hz).wavenumber(frequency_hz)
        # No plate's wave number falls with frequency, or grows with more than its square.
        length_mm = 2.0 * np.pi / max(abs(wavenumber[-1]), 1e-300)
        if not (abs(vector[2]) <= 1.0 and shortest_mm <= length_mm <= longest_mm):
            return 1.0
        if not abs(wavenumber[-1].imag) <= _MAX_LOSS * abs(wavenumber[-1]):
            return 1.0
        if not (np.isfinite(wavenumber) & (wavenumber.real > 0)).all():
            return 1.0
        share = float(np.clip(vector[4], 0.02, 1.0)) if pressure_share else 0.0
        waves = waves_of_actuators(wavenumber.tolist(), share, points_mm, actuator_mm, ())
        basis = np.linalg.qr(waves.transpose(0, 3, 2, 1))[0]
        explained = np.square(np.abs(np.einsum("fapc,fap->fac", basis.conj(), values))).sum(axis=(1, 2))
        return float(1.0 - explained @ weight / len(frequency_hz))

    if not energy > 0:
        raise ValueError("no transfer function is above 0")
    shortest_mm = MIN_WAVELENGTH_SPACINGS * spacing_mm
    longest_mm = MAX_WAVELENGTH_SIZES * float(np.hypot(*np.ptp(points_mm, axis=0)))
    if elastic_near is None:
        lengths_mm = np.geomspace(shortest_mm, longest_mm, _SCANNED_SPEEDS)
        loss = np.log(_SCANNED_LOSS * 2.0 * np.pi * middle_hz)
        highest_hz = frequency_hz[-1]
        starts = [
            np.array([np.log(length * highest_hz * (highest_hz / middle_hz) ** -slope), loss, slope, 0.0, 0.0])
            for slope in _SCANNED_SLOPES
            for length in lengths_mm
        ]
    else:
        starts = [np.array([*elastic_near.vector, _PRESSURE_SHARE]) for _ in _ELASTIC_SPEEDS]
        for start, ratio in zip(starts, _ELASTIC_SPEEDS, strict=True):
            start[0] += np.log(ratio)
    best = _simplex(left, min(starts, key=left), [0.03, 0.5, 0.1, 0.3, 0.02], 300)
    share = float(np.clip(best[4], 0.02, 1.0)) if pressure_share else 0.0
    return Dispersion._of_vector(best[:4], middle_hz), share, left(best)


def _simplex(misfit: Any, start: Float64Array, step: list[float], evaluations: int) -> Float64Array:
    simplex = np.vstack([start, start + np.diag(step)])
    options: Any = {"maxfev": evaluations, "maxiter": evaluations, "xatol": 1e-7, "fatol": 1e-9}
    options["initial_simplex"] = simplex
    return np.asarray(minimize(misfit, start, method="Nelder-Mead", options=options).x)
