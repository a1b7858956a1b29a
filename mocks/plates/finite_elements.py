"""A scalar wave on a plate of any outline, by finite elements: waves that the rim reflects.

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

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from config.outline import Outline
from mocks.plates.soft import MAGNET_RADIUS_MM, DampedWave

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]

ELEMENTS_PER_WAVELENGTH = 1.9
SOLVED_STEP_HZ = 26.0
"""Distance of the frequencies that are solved for; they go on to a quarter beyond the band."""
LEAST_NORM = 1e-10
"""Directions of the projected space below this share of the strongest are dropped."""
SMOOTHINGS = 8


@dataclass(frozen=True, slots=True)
class RitzModes:
    """A plate of few modes: q'' + (b + c a R) q' + c^2 diag(stiffness) q = c^2 force f, y = shapes q.

    Parameters
    ----------
    shapes : float64 array, shape (nodes, modes)
        Of every mode at the nodes of the elements.
    stiffness : float64 array, shape (modes,)
        Squares of wave numbers, in 1/m^2, >= 0.
    force : float64 array, shape (modes, actuators)
        What a unit force of each actuator does to each mode.
    rim : float64 array, shape (modes, modes)
        R: products of the shapes along the rim.
    """

    shapes: Float64Array
    stiffness: Float64Array
    force: Float64Array
    rim: Float64Array


@dataclass(frozen=True, slots=True)
class Triangles:
    """Triangles on a plate, those at the rim curved.

    Parameters
    ----------
    node_mm : float64 array, shape (nodes, 2)
        Corners, those of the outline first and in its order.
    corners : int64 array, shape (triangles, 3)
        Which nodes each triangle joins.
    half_mm : float64 array, shape (outline nodes, 2)
        Points of the outline half-way between each of its nodes and the next.
    """

    node_mm: Float64Array
    corners: NDArray[np.int64]
    half_mm: Float64Array


class Elements:
    """Finite elements of fourth order on triangles.

    Parameters
    ----------
    triangles : Triangles
        The plate.
    """

    def __init__(self, triangles: Triangles) -> None:
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
        basis = self.basis
        inside = basis.mapping.invF(point[:, :, None], tind=cell)
        weight = [np.ravel(basis.elem.gbasis(basis.mapping, inside, k, tind=cell)[0]) for k in range(basis.Nbfun)]
        return np.asarray(basis.element_dofs[:, cell].T), np.stack(weight, axis=1)

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


def spacing_mm(wave: DampedWave, highest_hz: float) -> float:
    """Length of elements for waves up to a frequency."""
    return 2e3 * np.pi / abs(complex(wave.wavenumber(highest_hz)).real) / ELEMENTS_PER_WAVELENGTH


def ritz_modes(
    elements: Elements, actuator_mm: Float64Array, wave: DampedWave, admittance: float, highest_hz: float
) -> RitzModes:
    """Find the modes that carry the response to some actuators up to a frequency.

    Parameters
    ----------
    elements : Elements
        On the plate.
    actuator_mm : float64 array, shape (actuators, 2)
        Centres of the actuators, with their radius within the plate.
    wave : DampedWave
        The medium.
    admittance : float
        Of the rim, >= 0.
    highest_hz : float
        Upper end of the band.
    """
    from scipy.linalg import eigh

    force = elements.forces(actuator_mm)
    solved_hz = np.linspace(0.6 * SOLVED_STEP_HZ, 1.25 * highest_hz, int(np.ceil(1.25 * highest_hz / SOLVED_STEP_HZ)))
    found = np.concatenate([elements.solve(wave, admittance, hertz, force) for hertz in solved_hz.tolist()], axis=1)
    space = np.concatenate([found.real, found.imag], axis=1)
    space /= np.sqrt(np.einsum("ij,ij->j", space, elements.mass @ space))
    norm, turn = eigh(space.T @ (elements.mass @ space))
    kept = norm > LEAST_NORM * norm[-1]
    space = space @ (turn[:, kept] / np.sqrt(norm[kept]))
    stiffness, turn = eigh(space.T @ (elements.stiffness @ space))
    shapes = space @ turn
    edge = np.unique(elements.rim.indices)
    rim = shapes[edge].T @ (elements.rim[edge][:, edge] @ shapes[edge])
    return RitzModes(shapes, np.maximum(stiffness, 0.0), shapes.T @ force, np.asarray(rim))


def triangulate(outline: Outline, spacing: float) -> Triangles:
    """Divide a plate into nearly equilateral triangles.

    Parameters
    ----------
    outline : Outline
        The plate's.
    spacing : float
        Length of a side in mm.
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

    for _ in range(SMOOTHINGS):
        corners = within()
        first, second = corners[:, [0, 1, 2]].ravel(), corners[:, [1, 2, 0]].ravel()
        both = np.concatenate([first, second]), np.concatenate([second, first])
        joined = coo_matrix((np.ones(len(both[0])), both), shape=(len(node), len(node))).tocsr()
        joined.data[:] = 1.0
        node[len(rim_mm) :] = ((joined @ node) / joined.sum(axis=1))[len(rim_mm) :]
    return Triangles(node, within(), half_mm)


def _scikit_fem() -> Any:
    try:
        import skfem
    except ImportError as error:
        raise ValueError(f'plates with a rim need scikit-fem ({error}): pip install "wavefocus[plates]"') from None
    return skfem
