"""Plates without a rim, tabulated over distance.

A response is a sum over kinds of waves (shear and pressure, say) and their kernels: functions of the distance, each
times a weight of the direction.
"""

from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from wavefocus.config.outline import Outline
from wavefocus.mocks.plates import MAGNET_RADIUS_MM, Chain, Complex64Array, Complex128Array, Float64Array, Plate

_NODES = 24  # Chebyshev nodes in log radius; the error they leave is measured in tests/unit/test_plates.py


class Wave(Protocol):
    """One kind of wave that leaves a disk."""

    def wavenumber(self, frequency_hz: Float64Array, /) -> Complex128Array:
        """Complex wavenumber in rad/m."""
        ...

    def kernels(self, frequency_hz: Float64Array, radius_mm: float, source_radius_mm: float) -> Complex128Array:
        """Velocities at a distance from a disk that pushes with unit force, (kernels, frequencies)."""
        ...


class PlateTable:
    """Velocity of one kind of wave on a fixed frequency grid, for distances chosen later.

    The wave is demodulated by exp(-j k r) / sqrt(r). What is left is so smooth in log r that a Chebyshev interpolation
    of low order does for all distances.

    wave: The wave.
    step_hz: Spacing of the frequencies in Hz, > 0; they are step_hz * (0, 1, ... bins - 1).
    bins: Number of frequencies, > 0.
    colour, complex (bins,): A transfer function multiplied into the table.
    furthest_mm: Largest distance of the table in mm; beyond it the plate is evaluated directly.
    source_radius_mm: Radius of the source in mm; nearer than that the plate is evaluated directly.
    single: Keep and return complex64 (relative error 1e-6) instead of complex128 (1e-9).
    """

    def __init__(
        self,
        wave: Wave,
        step_hz: float,
        bins: int,
        colour: NDArray[np.complex128],
        *,
        furthest_mm: float = 300.0,
        source_radius_mm: float = MAGNET_RADIUS_MM,
        single: bool = False,
    ) -> None:
        self._wave = wave
        self._step_hz = step_hz
        self._bins = bins
        self._colour = colour
        self._span_mm = (source_radius_mm, furthest_mm)
        self._source_radius_mm = source_radius_mm
        self._complex = np.dtype(np.complex64 if single else np.complex128)
        self._real = np.dtype(np.float32 if single else np.float64)

        angle = np.pi * (np.arange(_NODES) + 0.5) / _NODES
        self._nodes = np.cos(angle)
        self._weights = np.sin(angle) * (-1.0) ** np.arange(_NODES)
        low, high = np.log(self._span_mm)
        node_mm = np.exp(low + (high - low) * (self._nodes + 1) / 2)
        frequency_hz = step_hz * np.arange(bins, dtype=np.float64)
        self._turn_per_mm = -1e-3j * wave.wavenumber(frequency_hz)
        rows = [
            wave.kernels(frequency_hz, radius_mm, source_radius_mm) * colour / self._carrier(radius_mm)
            for radius_mm in node_mm.tolist()
        ]
        table = np.stack(rows, axis=1).astype(self._complex)
        self._kernels = len(table)
        self._table = table.reshape(self._kernels * _NODES, bins).view(self._real)

    def evaluate(
        self, radius_mm: Float64Array, weights: Float64Array | None = None
    ) -> NDArray[np.complex128] | NDArray[np.complex64]:
        """Velocity times colour at some distances.

        radius_mm, float64 (distances,): Distances in mm, >= 0.
        weights, float64 (distances, kernels), optional: Of the kernels; 1 where absent.

        Returns complex (distances, bins).
        """
        radius_mm = np.asarray(radius_mm, dtype=np.float64)
        low, high = self._span_mm
        tabulated = (radius_mm >= low) & (radius_mm <= high)
        held_mm = np.where(tabulated, radius_mm, high)
        result: NDArray[np.complex128] | NDArray[np.complex64] = self._carrier(held_mm[:, None]).astype(
            self._complex, copy=False
        )
        factors = self._interpolation(held_mm)
        if weights is not None:
            factors = (weights[:, :, None] * factors[:, None, :]).reshape(len(factors), -1).astype(self._real)
        result *= (factors @ self._table).view(self._complex)
        for row in np.flatnonzero(~tabulated):
            frequency_hz = self._step_hz * np.arange(self._bins, dtype=np.float64)
            kernels = self._wave.kernels(frequency_hz, float(radius_mm[row]), self._source_radius_mm)
            weight = np.ones(self._kernels) if weights is None else weights[row]
            result[row] = self._colour * (weight @ kernels)
        return result

    def _interpolation(self, radius_mm: Float64Array) -> NDArray[np.floating]:
        """Barycentric weights (second form) of every node for every distance."""
        low, high = np.log(self._span_mm)
        abscissa = 2 * (np.log(radius_mm) - low) / (high - low) - 1
        gap = abscissa[:, None] - self._nodes
        on_node = np.abs(gap) < 1e-15
        terms = self._weights / np.where(on_node, 1.0, gap)
        terms = np.where(on_node.any(axis=1, keepdims=True), on_node, terms)
        return np.asarray(terms / terms.sum(axis=1, keepdims=True), dtype=self._real)

    def _carrier(self, radius_mm: Float64Array | float) -> Complex128Array:
        return np.asarray(np.exp(self._turn_per_mm * radius_mm) / np.sqrt(radius_mm))


class InfinitePlate(Plate):
    """A plate whose waves leave each actuator and never come back.

    waves: Kinds of waves that it carries.
    """

    def __init__(self, actuator_mm: Float64Array, outline: Outline, chain: Chain, waves: tuple[Wave, ...]) -> None:
        super().__init__(actuator_mm, outline, chain)
        self._waves = waves
        left, bottom, right, top = outline.box_mm
        self._furthest_mm = float(np.hypot(right - left, top - bottom)) + 10
        self._table = lru_cache(6)(self._make_tables)

    def weights(self, gap_mm: Float64Array) -> Float64Array | None:
        """Weights of the kernels at gaps (n, 2) from an actuator to a place, (n, kernels); None for 1."""
        return None

    def response(
        self, place_mm: tuple[float, float], step_hz: float, bins: int, *, single: bool
    ) -> Complex64Array | Complex128Array:
        gap = np.asarray(place_mm, dtype=np.float64) - self._actuator_mm
        distance_mm, weights = np.hypot(*gap.T), self.weights(gap)
        total, *others = (table.evaluate(distance_mm, weights) for table in self._table(step_hz, bins, single))
        for part in others:
            total += part
        return total

    def _make_tables(self, step_hz: float, bins: int, single: bool) -> list[PlateTable]:
        chain = self._chain(step_hz * np.arange(bins, dtype=np.float64))
        return [
            PlateTable(wave, step_hz, bins, chain, furthest_mm=self._furthest_mm, single=single) for wave in self._waves
        ]
