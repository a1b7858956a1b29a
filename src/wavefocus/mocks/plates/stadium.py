"""The soft stadium: a gel plate with a rim that reflects, by finite elements; for any outline.

On the plate (laplacian + k^2) y = -q with k^2 = (w^2 - j w b) / c^2; on the rim dy/dn = -j w a / c y, where the
admittance a is 0 for a free edge and 1 for one that takes up what arrives at a right angle. In the weak form

    (K + j w a / c B - k^2 M) u = F.

Elements are of fourth order and half a wavelength across, those at the rim curved: at 450 Hz the error is 2e-3
(measured against elements of 3.5 mm). Time as exp(+j w t).

The response to the actuators is a smooth curve over frequency. It is solved for at some frequencies; real and imaginary
parts of the solutions span a space into which the whole system is projected (Galerkin; rational Krylov method, A. Ruhe,
Linear Algebra Appl. 58, 1984). What comes of it is a small plate of the same kind, symmetric and damped, with some
hundred modes: causal and passive at every frequency, and within 2e-3 of all elements in the band.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from wavefocus.config.outline import Outline
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
)
from wavefocus.mocks.plates.soft import SOFT_PLATE, UNIT_FORCE_N, DampedWave

_HIGHEST_HZ = 500.0
"""Upper end of the band in which the plate is accurate to 1 %; above, it is a causal plate with fewer modes."""
_RECIPE = 3
"""Raised when the same plate is computed in another way, so that no older file is used."""
_SOLVED_STEP_HZ = 26.0
"""Distance of the frequencies that are solved for; they go on to a quarter beyond the band."""


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
            kept = _kept("damped", (self._wave, *facts), lambda: _arrays(pairs()))
            self._pairs = _DampedPairs(*(kept[item.name] for item in fields(_DampedPairs)))

    def coefficients(self, place_mm: Float64Array) -> Float64Array:
        shapes = self._elements.values_at(place_mm, self._modes.shapes)
        if self._pairs is None:
            return np.asarray(shapes[:, None, :] * self._modes.force.T)
        part = (shapes @ self._pairs.shapes)[:, None, :] * self._pairs.force.T
        return np.concatenate([part.real, part.imag], axis=-1)

    def mode_velocities(self, frequency_hz: Float64Array) -> Complex128Array:
        angular = 2 * np.pi * np.asarray(frequency_hz, dtype=np.float64)
        if self._pairs is None:
            # j w / (k_mode^2 - k^2); at 0 Hz nothing moves.
            gap = self._modes.stiffness[:, None] - np.square(self._wave.wavenumber(frequency_hz))
            velocity = np.divide(1j * angular, gap, out=gap, where=angular > 0)
            velocity[:, angular <= 0] = 0
            return np.asarray(velocity)
        first = 1 / (1j * angular - self._pairs.rate_per_s[:, None])
        second = 1 / (1j * angular - self._pairs.rate_per_s[:, None].conj())
        return np.concatenate([first + second, 1j * (first - second)])

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
        triangles = triangulate(outline, spacing_mm(SOFT_PLATE, _HIGHEST_HZ))
        modes = _ritz_modes(Elements(triangles), actuator_mm, SOFT_PLATE, admittance, _HIGHEST_HZ)
        return _arrays(triangles) | _arrays(replace(modes, shapes=modes.shapes.astype(np.float32)))

    kept = _kept("stadium", facts, compute)
    triangles = _Triangles(*(kept[item.name] for item in fields(_Triangles)))
    return Elements(triangles), _RitzModes(*(kept[item.name] for item in fields(_RitzModes))), facts


def _arrays(part: _Triangles | _RitzModes | _DampedPairs) -> dict[str, NDArray[Any]]:
    return {item.name: getattr(part, item.name) for item in fields(part)}


def _kept(name: str, facts: tuple[object, ...], compute: Callable[[], dict[str, Any]]) -> Mapping[str, Any]:
    """Arrays from the disk, or computed and kept there; without a file that can be used, computed again."""
    digest = hashlib.sha256(repr((_RECIPE, *facts)).encode()).hexdigest()
    path = _cache_dir() / f"{name}-{digest[:32]}.npz"
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
            return dict(kept)
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        found = compute()
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".partial", delete=False) as written:
            np.savez(written, **found)
        Path(written.name).replace(path)
    return found


def _cache_dir() -> Path:
    """Folder of computed plates: WAVEFOCUS_CACHE, or the user's cache folder of this system."""
    if chosen := os.environ.get("WAVEFOCUS_CACHE"):
        return Path(chosen)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData/Local")) / "wavefocus" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library/Caches/wavefocus"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "wavefocus"


@dataclass(frozen=True, slots=True)
class _RitzModes:
    """A plate of few modes: q'' + (b + c a R) q' + c^2 diag(stiffness) q = c^2 force f, y = shapes q.

    shapes, float64 (nodes, modes): Of every mode at the nodes of the elements.
    stiffness, float64 (modes,): Squares of wave numbers, in 1/m^2, >= 0.
    force, float64 (modes, actuators): What a unit force of each actuator does to each mode.
    rim, float64 (modes, modes): R: products of the shapes along the rim.
    """

    shapes: Float64Array
    stiffness: Float64Array
    force: Float64Array
    rim: Float64Array


@dataclass(frozen=True, slots=True)
class _Triangles:
    """Triangles on a plate, those at the rim curved.

    node_mm, float64 (nodes, 2): Corners, those of the outline first and in its order.
    corners, int64 (triangles, 3): Which nodes each triangle joins.
    half_mm, float64 (outline nodes, 2): Points of the outline half-way between each of its nodes and the next.
    """

    node_mm: Float64Array
    corners: NDArray[np.int64]
    half_mm: Float64Array


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
        edge = skfem.FacetBasis(self.basis.mesh, self.basis.elem, intorder=2 * self.basis.elem.maxdeg + 2)
        return skfem.BilinearForm(lambda u, v, _: u * v).assemble(edge).tocsc()

    def basis_at(self, point_mm: Float64Array) -> tuple[NDArray[np.int64], Float64Array]:
        """Nodes whose values make up the value at points (n, 2) of the plate, and their weights; (n, 15) each."""
        point = np.ascontiguousarray(point_mm.T / 1e3)
        cell = self._find_cell(*point)
        # What lies in a curved triangle takes a search; elsewhere the map is affine.
        mapping = self.basis.mapping if self._is_curved[cell].any() else self._straight.mapping()
        inside = mapping.invF(point[:, :, None], tind=cell)[:, :, 0]
        weight = _powers(inside, self.basis.elem.maxdeg) @ self._weight_of_power
        return np.asarray(self.basis.element_dofs[:, cell].T), weight

    def values_at(self, point_mm: Float64Array, nodal: NDArray[Any]) -> Float64Array:
        """Values at points (n, 2) of functions given at the nodes, (nodes, functions): (n, functions)."""
        node, weight = self.basis_at(point_mm)
        return np.asarray(np.einsum("nk,nkf->nf", weight, nodal[node], optimize=True))

    def forces(self, actuator_mm: Float64Array, radius_mm: float = MAGNET_RADIUS_MM) -> Float64Array:
        """Loads (nodes, actuators) of disks that push with unit force."""
        node, weight = np.polynomial.legendre.leggauss(6)
        angle = 2 * np.pi * (np.arange(16) + 0.5) / 16
        ring_mm = radius_mm * np.sqrt((node + 1) / 2)
        disk_mm = (ring_mm[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)).reshape(-1, 2)
        share = np.repeat(weight / 2, len(angle)) / len(angle)
        loads = np.zeros((self.basis.N, len(actuator_mm)))
        for actuator, centre_mm in enumerate(actuator_mm):
            nodes, weights = self.basis_at(centre_mm + disk_mm)
            np.add.at(loads[:, actuator], nodes, weights * share[:, None])
        return loads

    def solve(self, wave: DampedWave, admittance: float, frequency_hz: float, force: Float64Array) -> Complex128Array:
        """Displacement (nodes, actuators) at one frequency, by a sparse factorisation."""
        from scipy.sparse.linalg import splu

        system = self.stiffness - complex(wave.wavenumber(frequency_hz)) ** 2 * self.mass
        if admittance:
            system = system + 2j * np.pi * frequency_hz * admittance / wave.speed_m_s * self.rim
        factors = splu(
            system.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        return np.asarray(factors.solve(force.astype(np.complex128)))


def _powers(place: Float64Array, degree: int) -> Float64Array:
    """Products of powers up to a degree, in all, of the coordinates (2, n) of points: (n, products)."""
    x, y = place
    return np.stack([x**first * y**other for first in range(degree + 1) for other in range(degree + 1 - first)], axis=1)


def spacing_mm(wave: DampedWave, highest_hz: float) -> float:
    """Length of elements for waves up to a frequency: 1.9 of them to a wavelength."""
    return 2e3 * np.pi / abs(complex(wave.wavenumber(highest_hz)).real) / 1.9


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
    from scipy.linalg import eigh
    from threadpoolctl import threadpool_limits

    force = elements.forces(actuator_mm)
    solved_hz = np.linspace(0.6 * _SOLVED_STEP_HZ, 1.25 * highest_hz, int(np.ceil(1.25 * highest_hz / _SOLVED_STEP_HZ)))
    # Made before the threads share them.
    stiffness_of_nodes, mass, rim_of_nodes = elements.stiffness, elements.mass, elements.rim

    def solved(frequency_hz: float) -> Complex128Array:
        return elements.solve(wave, admittance, frequency_hz, force)

    # SciPy factorises outside Python's lock, with some hundred megabytes each. Threads of BLAS would only spin.
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(min(os.cpu_count() or 1, 4)) as pool:
        found = np.concatenate(list(pool.map(solved, solved_hz.tolist())), axis=1)
    space = np.concatenate([found.real, found.imag], axis=1)
    gram = space.T @ (mass @ space)
    size = np.sqrt(np.diag(gram))
    norm, turn = eigh(gram / np.outer(size, size))
    # Directions of the projected space below this share of the strongest are dropped.
    kept = norm > 1e-10 * norm[-1]
    turn = turn[:, kept] / np.sqrt(norm[kept]) / size[:, None]
    stiffness, mode = eigh(turn.T @ (space.T @ (stiffness_of_nodes @ space)) @ turn)
    shapes = space @ (turn @ mode)
    edge = np.unique(rim_of_nodes.indices)
    rim = shapes[edge].T @ (rim_of_nodes[edge][:, edge] @ shapes[edge])
    return _RitzModes(shapes, np.maximum(stiffness, 0.0), shapes.T @ force, np.asarray(rim))


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
