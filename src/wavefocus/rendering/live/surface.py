"""The part of the surface that sources may be rendered on while they sound."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.greens.interpolation.base import (
    GridInterpolation,
    Nodes,
    OffGridError,
    interpolation_method,
    show_mm,
)
from wavefocus.rendering.greens.source import GreenSource, usable
from wavefocus.rendering.live.finer import FinerRows
from wavefocus.storage.errors import InputError


class PlayableSurface:
    """Places of a bank from which the interpolation can be made; a row is read when a place first needs it.

    interpolation: "nearest" or "bilinear"; "kernel" or "waves": the nearest of `finer` rows then.
    read: Reads a row. Raises InputError where it may not be used.

    Raises InputError: the bank does not allow the interpolation, or no position was measured.
    """

    x_mm: tuple[float, float]
    y_mm: tuple[float, float]
    """Bounding box of the positions that may be used."""

    def __init__(
        self, bank: GreenSource, interpolation: str, read: Callable[[int], None], finer: FinerRows | None = None
    ) -> None:
        self._finer = finer
        method = interpolation_method(interpolation if finer is None else "nearest")
        if not issubclass(method, GridInterpolation):
            raise InputError(
                f"interpolation is {interpolation!r}, which prepares a path beforehand; live sources need 'nearest',"
                " 'bilinear', 'kernel', 'waves' or 'auto'"
            )
        if reason := getattr(bank, "import_facts", {}).get("unsuited", {}).get(interpolation):
            raise InputError(f"interpolation is {interpolation!r}, and the bank was imported: {reason}; use 'nearest'")
        self._method = method.over(bank, np.zeros((0, 2)))
        self._read, self._usable = read, usable(bank)
        self._edges: Float64Array | None = None
        self._unread = self._usable.copy()
        self._note_doubts()
        if not self._usable.any():
            raise InputError("no position of the bank was measured; live sources need some")
        position_mm = np.asarray(bank.position_mm, dtype=np.float64)[self._usable]
        low_mm, high_mm = position_mm.min(axis=0), position_mm.max(axis=0)
        (left, lower), (right, upper) = low_mm.tolist(), high_mm.tolist()
        self.x_mm, self.y_mm = (left, right), (lower, upper)
        spacing_mm = self._method.grid.spacing_mm
        self._low_mm, self._high_mm = low_mm - spacing_mm, high_mm + spacing_mm
        # The first search beside the lattice loads a library: now, and not while sources sound.
        self._method.grid.nearest(self._low_mm[None])

    def holds(self, *places_mm: tuple[float, float]) -> bool:
        """Whether straight ways between places are on the surface for sure; False also where that takes a look."""
        if self._doubtful:
            return False
        if self._edges is None:
            self._edges = self._convex_edges()
        return not places_mm or bool((self._edges @ np.array([(*place, 1.0) for place in places_mm]).T <= 0.0).all())

    def _convex_edges(self) -> Float64Array:
        """Edges (n, 3) of the positions' convex hull, a x + b y + c <= 0; impossible ones where the hull has holes."""
        from scipy.spatial import ConvexHull, QhullError

        # Looks per grid spacing by which a convex grid is found to have no holes; larger grids are not looked at.
        position_mm, step_mm = self._method.grid.position_mm, self._method.grid.spacing_mm / 3.0
        nowhere = np.array([[0.0, 0.0, 1.0]])
        count = np.ptp(position_mm, axis=0) / max(step_mm, 1e-9)
        if count.prod() > 1e6:
            return nowhere
        try:
            edges = np.asarray(ConvexHull(position_mm).equations)
        except QhullError:  # all on one line
            return nowhere
        axes = [np.arange(low, high, step_mm) for low, high in zip(position_mm.min(0), position_mm.max(0), strict=True)]
        looks_mm = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        within = (looks_mm @ edges[:, :2].T + edges[:, 2] <= 0.0).all(axis=1)
        try:
            self.nodes(looks_mm[within])
        except OffGridError:
            return nowhere
        return edges

    def require(self, at_mm: tuple[float, float], name: str) -> None:
        """Raise InputError where a source may not be at a place in millimetres."""
        place_mm = np.array([at_mm], dtype=np.float64)
        try:
            nodes = self._method.nodes(place_mm)
        except OffGridError as error:
            raise InputError(f"the position of source {name!r} {error}") from error
        for row in _needed(nodes) if self._doubtful else ():
            try:
                self._admit(row)
            except InputError as error:
                raise InputError(f"source {name!r} may not be at {show_mm(place_mm[0])} mm: {error}") from error

    def stays(self, at_mm: tuple[float, float], velocity_mm: tuple[float, float], samples: int) -> int:
        """Number of samples, at most those given, for which a way stays within the bounding box, or as near to it.

        at_mm, velocity_mm: Where it begins, and its way per sample.
        """
        for place, step, (low, high) in zip(at_mm, velocity_mm, (self.x_mm, self.y_mm), strict=True):
            room = max(high, place) - place if step > 0 else place - min(low, place)
            if abs(step) * samples > room:
                samples = int(room / abs(step))
        return samples

    def nodes(self, at_mm: Float64Array) -> Nodes:
        """Rows of the bank and weights of places (n, 2).

        Raises OffGridError: its `point` is the first place that cannot be rendered from.
        """
        # Places far outside take long to search for.
        outside = (at_mm < self._low_mm) | (at_mm > self._high_mm)
        count = int(np.argmax(outside.any(axis=1))) if outside.any() else len(at_mm)
        beyond = OffGridError(count, "lies off the measured surface")
        while count:
            try:
                nodes = self._method.nodes(at_mm[:count])
            except OffGridError as error:
                count, beyond = error.point, error
                continue
            if self._doubtful:
                for row in _needed(nodes):
                    self.try_admit(row)
                refused = ~self._usable[nodes.nearest] | ((nodes.weights != 0) & ~self._usable[nodes.rows]).any(axis=1)
                if refused.any():
                    raise OffGridError(int(np.argmax(refused)), "lies where no position may be used")
            if count == len(at_mm):
                return nodes
            break
        raise beyond

    def nearest_nodes(self, at_mm: Float64Array) -> Nodes:
        """Rows, finer ones too, and weights of places (n, 2); off the surface those of the nearest usable position.

        A predicted way is looked at every few millimetres: between two looks it may cut a corner.
        """
        while True:
            try:
                nodes = self.nodes(at_mm)
                return nodes if self._finer is None else replace(nodes, rows=self._finer.nearest(at_mm)[:, None])
            except OffGridError as off:
                position_mm = self._method.grid.position_mm[self._usable]
                nearest = np.square(position_mm - at_mm[off.point]).sum(axis=1).argmin()
                at_mm = at_mm.copy()
                at_mm[off.point] = position_mm[nearest]

    def try_admit(self, row: int) -> None:
        """Read a row if that was not done yet, and note whether it may be used."""
        if self._unread[row]:
            with suppress(InputError):
                self._admit(row)

    def _note_doubts(self) -> None:
        self._doubtful = bool(self._unread.any()) or not self._usable.all()

    def _admit(self, row: int) -> None:
        if self._unread[row]:
            self._unread[row] = self._usable[row] = False
            self._read(row)
            self._usable[row] = True
            self._note_doubts()
        elif not self._usable[row]:
            self._read(row)  # says why


def _needed(nodes: Nodes) -> list[int]:
    """Rows that nodes are made of or regularised by, in the order in which they are needed."""
    nearest = nodes.nearest[:, None]
    found, first = np.unique(
        np.concatenate([nearest, np.where(nodes.weights != 0, nodes.rows, nearest)], axis=1), return_index=True
    )
    needed: list[int] = found[np.argsort(first)].tolist()
    return needed
