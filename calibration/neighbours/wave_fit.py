"""The waves of a bank, found by leaving positions out: no plate model, no actuator positions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.neighbours.wave_model import WaveModel, kernel_parts

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]
Int64Array = NDArray[np.int64]

SCANNED_RADIANS = np.geomspace(0.1, 3.6, 24)
"""Wave numbers tried, times the grid spacing: from 60 positions per wavelength to fewer than two."""
SCAN_DAMPING, SCAN_SHARE, SCAN_RIDGE = 0.1, 0.1, 1e-4
FIT_SHARE, FIT_RIDGE = 0.01, 1e-4
"""Little of the disk, so that only the right wave number explains what is there; a ridge, so that it must."""
SHARES = (1e-3, 1e-2, 0.1, 1.0)
RIDGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
EVALUATIONS = 45
EVERY = 2
LEFT_OUT = 5
"""Positions of each patch that are left out: the first and its nearest, which still have others all round."""
MARGIN = 1.02
"""A larger share of the disk is taken where it leaves at most this much more unexplained: it claims less."""


class Patch(Protocol):
    """A position and its neighbours: bank rows (n,), the position's own first, places relative to it (n, 2)."""

    @property
    def rows(self) -> Int64Array: ...

    @property
    def offset_mm(self) -> Float64Array: ...

    @property
    def key(self) -> bytes:
        """Equal for patches of equal shape."""


class Values(Protocol):
    """Rows at some frequencies."""

    @property
    def frequency_hz(self) -> Float64Array: ...

    def of(self, rows: Int64Array) -> Complex128Array:
        """Values of rows, (frequencies, rows, actuators)."""


def fit_waves(patches: Sequence[Patch], values: Values, spacing_mm: float) -> WaveModel:
    """Find wave number, disk share and ridge at each frequency.

    Each patch's first positions are left out, one at a time, and predicted from its others; what is least is
    the error of all patches and actuators, each patch relative to its own strength. The wave number is scanned
    for and then refined together with its damping; share and ridge are chosen from a few. They are not refined
    together: with much of the disk any wave number will do, and between two such frequencies none would be right.

    patches: Spread over the surface or along a path, at least one.
    values: The rows, at more frequencies than are fitted: the highest of them, every second one below, and the lowest.
    spacing_mm: Grid spacing.
    """
    shapes = _gather(patches, values)
    chosen = sorted({0, *range(len(values.frequency_hz) - 1, -1, -EVERY)})
    found = [_Fit([(offset_mm, parts[number]) for offset_mm, parts in shapes]).run(spacing_mm) for number in chosen]
    return WaveModel(
        values.frequency_hz[chosen],
        np.array([item[0] for item in found]),
        np.array([item[1] for item in found]),
        np.array([item[2] for item in found]),
    )


class _Fit:
    """The search at one frequency.

    shapes, sequence of (float64 array, complex128 array): Positions of patches of one shape, (n, 2), and their values
        side by side, (n, patches * actuators).
    """

    def __init__(self, shapes: Sequence[tuple[Float64Array, Complex128Array]]) -> None:
        # Shapes of equally many positions go through linear algebra together.
        self._stacks: list[tuple[Float64Array, list[Complex128Array]]] = []
        for count in sorted({len(offset_mm) for offset_mm, _ in shapes}):
            alike = [shape for shape in shapes if len(shape[0]) == count]
            self._stacks.append((np.stack([offset_mm for offset_mm, _ in alike]), [values for _, values in alike]))
        self._whole = sum(float(np.square(np.abs(values[:LEFT_OUT])).sum()) for _, values in shapes)
        self._latest: tuple[complex, list[tuple[Complex128Array, Float64Array]]] | None = None

    def run(self, spacing_mm: float) -> tuple[complex, float, float]:
        scanned = SCANNED_RADIANS / spacing_mm
        misfits = [self._misfit(complex(k, -SCAN_DAMPING * k), SCAN_SHARE, SCAN_RIDGE) for k in scanned]
        start = float(scanned[int(np.argmin(misfits))])
        wavenumber = self._refined(complex(start, -SCAN_DAMPING * start))
        return wavenumber, *self._chosen(wavenumber)

    def _refined(self, wavenumber: complex) -> complex:
        from scipy.optimize import minimize  # most campaigns need it at their end only, small ones never

        # In units of the first guess, so that the simplex has the right size both ways.
        unit = wavenumber.real

        def misfit(x: Float64Array) -> float:
            if not 0.3 < x[0] < 3.0:
                return 10.0
            damped = complex(unit * x[0], -unit * abs(x[1]))
            return float(np.log(max(self._misfit(damped, FIT_SHARE, FIT_RIDGE), 1e-300)))

        first = np.array([1.0, -wavenumber.imag / unit])
        simplex = first + np.array([[0.0, 0.0], [0.03, 0.0], [0.0, 0.03]])
        options: Any = {"maxfev": EVALUATIONS, "xatol": 1e-4, "fatol": 1e-3, "initial_simplex": simplex}
        best = minimize(misfit, first, method="Nelder-Mead", options=options).x
        return complex(unit * best[0], -unit * abs(best[1]))

    def _chosen(self, wavenumber: complex) -> tuple[float, float]:
        choices = [(share, ridge) for share in SHARES for ridge in RIDGES]
        misfits = [self._misfit(wavenumber, *choice) for choice in choices]
        enough = MARGIN**2 * min(misfits)
        return max(choice for choice, misfit in zip(choices, misfits, strict=True) if misfit <= enough)

    def _misfit(self, wavenumber: complex, share: float, ridge: float) -> float:
        """Energy of the errors at the positions left out, over that of what is there."""
        if self._latest is None or self._latest[0] != wavenumber:
            one = np.array([wavenumber])
            self._latest = (wavenumber, [kernel_parts(one, offset_mm) for offset_mm, _ in self._stacks])
        wrong = 0.0
        for (_, values), (ring, disk) in zip(self._stacks, self._latest[1], strict=True):
            covariance = (1.0 - share) * ring + share * disk
            count = covariance.shape[1]
            covariance[:, range(count), range(count)] += ridge
            # Columns of the inverse, which is Hermitian: (C^-1 g)_i / (C^-1)_ii is the error at position i.
            columns = np.linalg.solve(covariance, np.eye(count, min(LEFT_OUT, count)))
            for column, value in zip(columns, values, strict=True):
                own = column[range(column.shape[1]), range(column.shape[1])].real
                wrong += float(np.square(np.abs((column.conj().T / own[:, None]) @ value)).sum())
        return wrong / self._whole if self._whole > 0 else 1.0


def _gather(patches: Sequence[Patch], values: Values) -> list[tuple[Float64Array, Complex128Array]]:
    """Patches by shape: positions (n, 2), values (frequencies, n, patches * actuators)."""
    by_shape: dict[bytes, list[Patch]] = {}
    for patch in patches:
        by_shape.setdefault(patch.key, []).append(patch)
    shapes = []
    for alike in by_shape.values():
        parts = []
        for patch in alike:
            part = values.of(patch.rows)
            strength = np.sqrt(np.mean(np.square(np.abs(part)), axis=(1, 2), keepdims=True))
            parts.append(part / np.where(strength > 0, strength, 1.0))
        shapes.append((alike[0].offset_mm, np.concatenate(parts, axis=2)))
    return shapes
