"""The soft stadium: a gel plate with a rim that reflects, by finite elements; for any outline.

On the plate (laplacian + k^2) y = -q with k^2 = (w^2 - j w b) / c^2; on the rim dy/dn = -j w a / c y, where the
admittance a is 0 for a free edge and 1 for one that takes up what arrives at a right angle. In the weak form

    (K + j w a / c B - k^2 M) u = F.

Elements are of fourth order and half a wavelength across, those at the rim curved: at 450 Hz the error is 2e-3
(measured against elements of 3.5 mm). Time as exp(+j w t).

The response to the actuators is a smooth curve over frequency. It is solved for at some frequencies, with its slope;
real and imaginary parts of the solutions span a space into which the whole system is projected (Galerkin; rational
Krylov method, A. Ruhe, Linear Algebra Appl. 58, 1984). What comes of it is a small plate of the same kind, symmetric
and damped, with some hundred modes: causal and passive at every frequency, and within 2e-3 of all elements in the band.

Where the outline mirrors itself in both axes, elements cover a quarter of the plate: modes are even or odd in x and y.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from itertools import takewhile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.config.outline import EDGE_TOLERANCE_MM, Outline, Segment
from wavefocus.mocks.plates import (
    MAGNET_RADIUS_MM,
    PLATES,
    UNCHANGED,
    Chain,
    Complex128Array,
    Float64Array,
    ModalPlate,
    PlateChange,
    Smoothness,
    kept_arrays,
)
from wavefocus.mocks.plates.soft import SOFT_PLATE, UNIT_FORCE_N, DampedWave

_HIGHEST_HZ = 500.0
"""Upper end of the band in which the plate is accurate to 1 %; above, it is a causal plate with fewer modes."""
_RECIPE = 4
"""Raised when the same plate is computed in another way, so that no older file is used."""
_SOLVED_STEP_HZ = 50.0
"""Distance of the frequencies that are solved for; they go on to a fifth beyond the band."""
_EVEN = np.zeros((1, 2), dtype=np.bool_)
_PARITIES = np.array([[False, False], [True, False], [False, True], [True, True]])
"""Whether a function changes its sign with that of x and of y."""


@PLATES.register
class StadiumPlate(ModalPlate):
    """A soft plate whose rim is free or takes up waves; everything else is the medium of the infinite soft plate.

    actuator_mm, outline, chain: See `Plate`.
    rim_admittance: Of the rim, relative to the medium's: 0 is a free edge, 1 takes up what arrives at a right angle.
    """

    name = "stadium"
    unit_force_n = UNIT_FORCE_N

    def __init__(
        self,
        actuator_mm: Float64Array,
        outline: Outline,
        chain: Chain,
        *,
        rim_admittance: float = 0.0,
        change: PlateChange = UNCHANGED,
    ) -> None:
        super().__init__(actuator_mm, outline, change.softened(chain))
        self._wave = SOFT_PLATE.changed(change)
        self._elements, self._modes, facts = _elements_and_modes(actuator_mm, outline, rim_admittance)
        self._pairs = None
        if rim_admittance:
            pairs = partial(_damped_pairs, self._modes, self._wave, rim_admittance)
            kept = kept_arrays("damped", (_RECIPE, self._wave, *facts), lambda: _arrays(pairs()))
            self._pairs = _DampedPairs(*(kept[item.name] for item in fields(_DampedPairs)))

    def coefficients(self, place_mm: Float64Array) -> Float64Array:
        shapes = self._elements.values_at(place_mm, self._modes.shapes, self._modes.is_odd)
        if self._pairs is None:
            return np.asarray(shapes[:, None, :] * self._modes.force.T)
        part = (shapes @ self._pairs.shapes)[:, None, :] * self._pairs.force.T
        return np.concatenate([part.real, part.imag], axis=-1)

    def mode_velocities(self, frequency_hz: Float64Array) -> Complex128Array:
        angular = 2 * np.pi * np.asarray(frequency_hz, dtype=np.float64)
        if self._pairs is None:
            # j w / (k_mode^2 - k^2)
            gap = self._modes.stiffness[:, None] - np.square(self._wave.wavenumber(frequency_hz))
            velocity = np.divide(1j * angular, gap, out=gap, where=angular > 0)
        else:
            first = 1 / (1j * angular - self._pairs.rate_per_s[:, None])
            second = 1 / (1j * angular - self._pairs.rate_per_s[:, None].conj())
            velocity = np.concatenate([first + second, 1j * (first - second)])
        # At 0 Hz nothing moves.
        velocity[:, angular <= 0] = 0
        return np.asarray(velocity)

    @property
    def smoothness(self) -> Smoothness:
        # Below, overdamped modes creep; from above, their poles are as far off as the frequency.
        decay_per_s = self._wave.damping_per_s / 2
        # Frequency in units of the slowest decay.
        return Smoothness(1.5 * decay_per_s / (2 * np.pi), decay_per_s)


@dataclass(frozen=True, slots=True)
class _DampedPairs:
    """Modes of a damped rim, one of each conjugate pair: (pairs,), (modes, pairs) and (pairs, actuators)."""

    rate_per_s: Complex128Array
    shapes: Complex128Array
    force: Complex128Array


def _damped_pairs(modes: _RitzModes, wave: DampedWave, admittance: float) -> _DampedPairs:
    from scipy.linalg import eig, solve

    speed, count = wave.speed_m_s, len(modes.stiffness)
    system = np.zeros((2 * count, 2 * count))
    system[:count, count:] = np.eye(count)
    system[count:, :count] = -(speed**2) * np.diag(modes.stiffness)
    system[count:, count:] = -wave.damping_per_s * np.eye(count) - speed * admittance * modes.rim
    rate, shape = eig(system)
    force = np.concatenate([np.zeros_like(modes.force), speed**2 * modes.force])
    reached = solve(shape, force.astype(np.complex128))
    kept = rate.imag >= 0
    # A real rate has no partner; its two halves are counted as a pair.
    share = np.where(rate.imag[kept] > 0, 1.0, 0.5)
    return _DampedPairs(rate[kept], shape[count:, kept], reached[kept] * share[:, None])


def _elements_and_modes(
    actuator_mm: Float64Array, outline: Outline, admittance: float
) -> tuple[Elements, _RitzModes, tuple[object, ...]]:
    """Elements and modes, from the disk or computed, and the facts that they follow from."""
    facts = (SOFT_PLATE, _HIGHEST_HZ, outline, admittance, np.asarray(actuator_mm, dtype=np.float64).tolist())

    def compute() -> dict[str, NDArray[Any]]:
        part = quarter_of(outline)
        triangles = triangulate(part or outline, spacing_mm(SOFT_PLATE, _HIGHEST_HZ))
        triangles = replace(triangles, is_quarter=np.array(part is not None))
        modes = _ritz_modes(Elements(triangles), actuator_mm, SOFT_PLATE, admittance, _HIGHEST_HZ)
        return _arrays(triangles) | _arrays(replace(modes, shapes=modes.shapes.astype(np.float32)))

    kept = kept_arrays("stadium", (_RECIPE, *facts), compute)
    triangles = _Triangles(*(kept[item.name] for item in fields(_Triangles)))
    return Elements(triangles), _RitzModes(*(kept[item.name] for item in fields(_RitzModes))), facts


def _arrays(part: _Triangles | _RitzModes | _DampedPairs) -> dict[str, NDArray[Any]]:
    return {item.name: getattr(part, item.name) for item in fields(part)}


@dataclass(frozen=True, slots=True)
class _RitzModes:
    """A plate of few modes: q'' + (b + c a R) q' + c^2 diag(stiffness) q = c^2 force f, y = shapes q.

    shapes, float64 (nodes, modes): Of every mode at the nodes of the elements.
    is_odd, bool (modes, 2): Whether it changes its sign with that of x and of y, where elements cover a quarter.
    stiffness, float64 (modes,): Squares of wave numbers, in 1/m^2, >= 0.
    force, float64 (modes, actuators): What a unit force of each actuator does to each mode.
    rim, float64 (modes, modes): R: products of the shapes along the rim.
    """

    shapes: Float64Array
    is_odd: NDArray[np.bool_]
    stiffness: Float64Array
    force: Float64Array
    rim: Float64Array


@dataclass(frozen=True, slots=True)
class _Triangles:
    """Triangles on a plate, those at the rim curved.

    node_mm, float64 (nodes, 2): Corners, those of the outline first and in its order.
    corners, int64 (triangles, 3): Which nodes each triangle joins.
    half_mm, float64 (outline nodes, 2): Points of the outline half-way between each of its nodes and the next.
    is_quarter, bool (): Whether they cover the quarter at x, y >= 0 of a plate that mirrors itself in both axes.
    """

    node_mm: Float64Array
    corners: NDArray[np.int64]
    half_mm: Float64Array
    is_quarter: NDArray[np.bool_] = field(default_factory=lambda: np.array(False))


class Elements:
    """Finite elements of fourth order on triangles.

    triangles: The plate.
    """

    def __init__(self, triangles: _Triangles) -> None:
        skfem = _scikit_fem()
        corner = np.ascontiguousarray(triangles.node_mm.T / 1e3)
        self._straight = skfem.MeshTri(corner, np.ascontiguousarray(triangles.corners.T))
        mesh = skfem.MeshTri2.from_mesh(self._straight)
        # The outline's nodes come first and in order: an edge from i to i + 1 has its middle at half i.
        rim = mesh.boundary_facets()
        ends = np.sort(mesh.facets[:, rim], axis=0)
        first = np.where(ends[1] - ends[0] == 1, ends[0], ends[1])
        node = mesh.doflocs.copy()
        node[:, self._straight.p.shape[1] + rim] = triangles.half_mm[first].T / 1e3
        order = skfem.ElementTriP4()
        self._find_cell = self._straight.element_finder()
        self._is_quarter = bool(triangles.is_quarter)
        self.basis = skfem.Basis(type(mesh)(node, mesh.t), order, intorder=2 * order.maxdeg + 2)
        self._is_curved = np.isin(np.arange(mesh.t.shape[1]), mesh.f2t[0, rim])
        self._weight_of_power = np.linalg.inv(_powers(order.doflocs.T, order.maxdeg))

    @cached_property
    def stiffness(self) -> Any:
        """K, sparse (nodes, nodes)."""
        from skfem.helpers import dot, grad

        return _scikit_fem().BilinearForm(lambda u, v, _: dot(grad(u), grad(v))).assemble(self.basis).tocsc()

    @cached_property
    def mass(self) -> Any:
        """M, sparse (nodes, nodes), in m^2."""
        return _scikit_fem().BilinearForm(lambda u, v, _: u * v).assemble(self.basis).tocsc()

    @cached_property
    def rim(self) -> Any:
        """B, sparse (nodes, nodes), in m."""
        skfem = _scikit_fem()
        mesh = self.basis.mesh
        # The straight sides of a quarter lie within the plate.
        facets = mesh.boundary_facets()
        if self._is_quarter:
            facets = mesh.facets_satisfying(lambda x: x.min(axis=0) > 1e-9, boundaries_only=True)
        edge = skfem.FacetBasis(mesh, self.basis.elem, facets=facets, intorder=2 * self.basis.elem.maxdeg + 2)
        return skfem.BilinearForm(lambda u, v, _: u * v).assemble(edge).tocsc()

    def basis_at(self, point_mm: Float64Array) -> tuple[NDArray[np.int64], Float64Array]:
        """Nodes whose values make up the value at points (n, 2) of the plate, and their weights; (n, 15) each."""
        point = np.ascontiguousarray((np.abs(point_mm) if self._is_quarter else point_mm).T / 1e3)
        cell = self._find_cell(*point)
        # What lies in a curved triangle takes a search; elsewhere the map is affine.
        mapping = self.basis.mapping if self._is_curved[cell].any() else self._straight.mapping()
        inside = mapping.invF(point[:, :, None], tind=cell)[:, :, 0]
        weight = _powers(inside, self.basis.elem.maxdeg) @ self._weight_of_power
        return np.asarray(self.basis.element_dofs[:, cell].T), weight

    @property
    def parities(self) -> NDArray[np.bool_]:
        """Parities (n, 1, 2) of functions on the plate: on all of it they are not told apart."""
        return _PARITIES[:, None] if self._is_quarter else _EVEN[None]

    def sign_at(self, point_mm: Float64Array, is_odd: NDArray[np.bool_]) -> Float64Array:
        """Signs (n, functions) at points (n, 2) of functions that are even or odd, (functions, 2)."""
        return np.asarray(np.where(is_odd, np.sign(point_mm)[:, None], 1.0).prod(axis=-1))

    def values_at(self, point_mm: Float64Array, nodal: NDArray[Any], is_odd: NDArray[np.bool_] = _EVEN) -> Float64Array:
        """Values at points (n, 2) of functions given at the nodes, (nodes, functions): (n, functions)."""
        node, weight = self.basis_at(point_mm)
        return np.asarray(np.einsum("nk,nkf->nf", weight, nodal[node], optimize=True)) * self.sign_at(point_mm, is_odd)

    def forces(
        self, actuator_mm: Float64Array, radius_mm: float = MAGNET_RADIUS_MM, is_odd: NDArray[np.bool_] = _EVEN
    ) -> Float64Array:
        """Loads (nodes, actuators) of disks that push with unit force; on a quarter, of their part of one parity."""
        node, weight = np.polynomial.legendre.leggauss(6)
        angle = 2 * np.pi * (np.arange(16) + 0.5) / 16
        ring_mm = radius_mm * np.sqrt((node + 1) / 2)
        disk_mm = (ring_mm[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)).reshape(-1, 2)
        share = np.repeat(weight / 2, len(angle)) / len(angle)
        if self._is_quarter:
            share = share / 4
        loads = np.zeros((self.basis.N, len(actuator_mm)))
        for actuator, centre_mm in enumerate(actuator_mm):
            nodes, weights = self.basis_at(centre_mm + disk_mm)
            sign = self.sign_at(centre_mm + disk_mm, is_odd)
            np.add.at(loads[:, actuator], nodes, weights * share[:, None] * sign)
        return loads

    def inverse(
        self, wave: DampedWave, admittance: float, frequency_hz: float, is_odd: NDArray[np.bool_] = _EVEN
    ) -> Callable[[NDArray[Any]], Complex128Array]:
        """What makes of loads (nodes, n) the displacements at one frequency, by a sparse factorisation."""
        from scipy.sparse.linalg import splu

        # What is odd rests on an axis of the plate.
        free = ((self.basis.doflocs.T > 1e-9) | ~is_odd).all(axis=1)
        system = self.stiffness - complex(wave.wavenumber(frequency_hz)) ** 2 * self.mass
        if admittance:
            system = system + 2j * np.pi * frequency_hz * admittance / wave.speed_m_s * self.rim
        factors = splu(
            system[free][:, free].tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            relax=2,
            options={"SymmetricMode": True},
        )

        def displacement(load: NDArray[Any]) -> Complex128Array:
            moved = np.zeros(load.shape, dtype=np.complex128)
            moved[free] = factors.solve(load[free].astype(np.complex128))
            return moved

        return displacement


def _powers(place: Float64Array, degree: int) -> Float64Array:
    """Products of powers up to a degree, in all, of the coordinates (2, n) of points: (n, products)."""
    x, y = place
    return np.stack([x**first * y**other for first in range(degree + 1) for other in range(degree + 1 - first)], axis=1)


def spacing_mm(wave: DampedWave, highest_hz: float) -> float:
    """Length of elements for waves up to a frequency: 2.1 of them to a wavelength."""
    return 2e3 * np.pi / abs(complex(wave.wavenumber(highest_hz)).real) / 2.1


def _ritz_modes(
    elements: Elements, actuator_mm: Float64Array, wave: DampedWave, admittance: float, highest_hz: float
) -> _RitzModes:
    """Find the modes that carry the response to some actuators up to a frequency.

    elements: On the plate.
    actuator_mm, float64 (actuators, 2): Centres of the actuators, with their radius within the plate.
    wave: The medium.
    admittance: Of the rim, >= 0.
    highest_hz: Upper end of the band.
    """
    from scipy.linalg import block_diag
    from threadpoolctl import threadpool_limits

    solved_hz = np.linspace(0.6 * _SOLVED_STEP_HZ, 1.2 * highest_hz, int(np.ceil(1.2 * highest_hz / _SOLVED_STEP_HZ)))

    def solved(load: Float64Array, is_odd: NDArray[np.bool_], frequency_hz: float) -> Complex128Array:
        displacement = elements.inverse(wave, admittance, frequency_hz, is_odd)
        response = displacement(load)
        return np.concatenate([response, displacement(elements.mass @ response)], axis=1)

    # Made before the threads share them.
    _ = elements.stiffness, elements.mass, elements.rim
    parts = []
    # SciPy factorises outside Python's lock, with some hundred megabytes each. Threads of BLAS would only spin.
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(min(os.cpu_count() or 1, 4)) as pool:
        for is_odd in elements.parities:
            force = elements.forces(actuator_mm, is_odd=is_odd)
            # Actuators that mirror each other load a parity alike, and one on an axis does not load what is odd there.
            load, size, _ = np.linalg.svd(force, full_matrices=False)
            solve = partial(solved, load[:, size > 1e-9], is_odd)
            found = np.concatenate(list(pool.map(solve, solved_hz.tolist())), axis=1)
            if found.size:
                parts.append(_projected(elements, found, force, is_odd))
    return _RitzModes(
        np.concatenate([part.shapes for part in parts], axis=1),
        np.concatenate([part.is_odd for part in parts]),
        np.concatenate([part.stiffness for part in parts]),
        np.concatenate([part.force for part in parts]),
        block_diag(*(part.rim for part in parts)),
    )


def _projected(
    elements: Elements, found: Complex128Array, force: Float64Array, is_odd: NDArray[np.bool_]
) -> _RitzModes:
    """Project a plate of one parity into the space of the solutions found, (nodes, solutions)."""
    from scipy.linalg import eigh

    space = np.concatenate([found.real, found.imag], axis=1)
    gram = space.T @ (elements.mass @ space)
    size = np.sqrt(np.diag(gram))
    norm, turn = eigh(gram / np.outer(size, size))
    # Directions of the projected space below this share of the strongest are dropped.
    kept = norm > 1e-10 * norm[-1]
    turn = turn[:, kept] / np.sqrt(norm[kept]) / size[:, None]
    stiffness, mode = eigh(turn.T @ (space.T @ (elements.stiffness @ space)) @ turn)
    shapes = space @ (turn @ mode)
    edge = np.unique(elements.rim.indices)
    rim = shapes[edge].T @ (elements.rim[edge][:, edge] @ shapes[edge])
    parity = np.repeat(is_odd, len(stiffness), axis=0)
    return _RitzModes(shapes, parity, np.maximum(stiffness, 0.0), shapes.T @ force, np.asarray(rim))


def quarter_of(outline: Outline) -> Outline | None:
    """The part of an outline at x, y >= 0, closed along the axes; None of one that does not mirror itself in both."""
    point = outline.nodes(outline.perimeter_mm / 400)[0]
    begin = outline.segments[0].start
    mirrored = (np.abs(outline.depth_mm(point * flip)).max() <= EDGE_TOLERANCE_MM for flip in ((-1, 1), (1, -1)))
    if begin[0] <= 0 or begin[1] != 0 or not all(mirrored):
        return None
    part = list(takewhile(lambda segment: segment.end[0] > EDGE_TOLERANCE_MM, outline.segments))
    # The next ends on the y axis, or crosses it at a right angle.
    last = outline.segments[len(part)]
    top = (0.0, last.end[1])
    return Outline((*part, replace(last, end=top), Segment(top, (0.0, 0.0)), Segment((0.0, 0.0), begin)))


def triangulate(outline: Outline, spacing: float) -> _Triangles:
    """Divide a plate into nearly equilateral triangles.

    outline: The plate's.
    spacing: Length of a side in mm.
    """
    from scipy.sparse import coo_matrix
    from scipy.spatial import Delaunay

    rim_mm, half_mm = outline.nodes(spacing)
    (left, low), (right, high) = rim_mm.min(axis=0), rim_mm.max(axis=0)
    line = np.arange(low, high, spacing * np.sqrt(0.75))
    row = np.arange(left - spacing, right + spacing, spacing)
    x, y = np.meshgrid(row, line)
    x[1::2] += spacing / 2
    inner = np.column_stack([x.ravel(), y.ravel()])
    node = np.concatenate([rim_mm, inner[outline.depth_mm(inner) > 0.6 * spacing]])

    def within() -> NDArray[np.int64]:
        corners = Delaunay(node).simplices
        a, b, c = (node[corners[:, k]] for k in range(3))
        area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        kept = (np.abs(area) > 1e-3 * spacing**2) & (outline.depth_mm((a + b + c) / 3) > 0)
        return np.asarray(corners[kept], dtype=np.int64)

    for _ in range(8):
        corners = within()
        first, second = corners[:, [0, 1, 2]].ravel(), corners[:, [1, 2, 0]].ravel()
        both = np.concatenate([first, second]), np.concatenate([second, first])
        joined = coo_matrix((np.ones(len(both[0])), both), shape=(len(node), len(node))).tocsr()
        joined.data[:] = 1.0
        node[len(rim_mm) :] = ((joined @ node) / joined.sum(axis=1))[len(rim_mm) :]
    return _Triangles(node, within(), half_mm)


def _scikit_fem() -> Any:
    try:
        import skfem
    except ImportError as error:
        raise ValueError(f'plates with a rim need scikit-fem ({error}): pip install "wavefocus[plates]"') from None
    return skfem
