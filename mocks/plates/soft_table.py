"""A plate tabulated over distance, so that any distance costs one small matrix product."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mocks.plates.soft import MAGNET_RADIUS_MM, DampedWave

Float64Array = NDArray[np.float64]
ComplexType = type[np.complex64] | type[np.complex128]

NODES = 24  # Chebyshev nodes in log radius; the error they leave is measured in tests/unit/test_plates.py
PHASE_BLOCK = 256
LOW_HZ = 100.0  # below, diffusion bends the wavenumber away from that of the plain damped wave


class PlateTable:
    """Velocity of the soft plate on a fixed frequency grid, for distances chosen later.

    The wave is demodulated by a carrier: below 100 Hz exp(-j k r) / sqrt(r), above it the plain damped
    wave exp(-j w r / c - b r / (2 c)) / sqrt(r), which costs two short exponentials. What is left is so
    smooth in log r that a Chebyshev interpolation of low order does for all distances.

    Parameters
    ----------
    wave : DampedWave
        The plate.
    step_hz : float
        Spacing of the frequencies in Hz, > 0; they are step_hz * (0, 1, ... bins - 1).
    bins : int
        Number of frequencies, > 0.
    colour : complex array, shape (bins,)
        A transfer function multiplied into the table.
    furthest_mm : float
        Largest distance of the table in mm; beyond it the plate is evaluated directly.
    source_radius_mm : float
        Radius of the source in mm; nearer than that the plate is evaluated directly.
    single : bool
        Keep and return complex64 (relative error 1e-6) instead of complex128 (1e-9).
    """

    def __init__(
        self,
        wave: DampedWave,
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
        self._complex: ComplexType = np.complex64 if single else np.complex128
        self._real = np.dtype(np.float32 if single else np.float64)

        angle = np.pi * (np.arange(NODES) + 0.5) / NODES
        self._nodes = np.cos(angle)
        self._weights = np.sin(angle) * (-1.0) ** np.arange(NODES)
        low, high = np.log(self._span_mm)
        node_mm = np.exp(low + (high - low) * (self._nodes + 1) / 2)
        frequency_hz = step_hz * np.arange(bins)
        table = np.empty((NODES, bins), dtype=self._complex)
        self._low_wavenumber = wave.wavenumber(frequency_hz[frequency_hz < LOW_HZ])
        for row, radius_mm in enumerate(node_mm):
            carrier = self._decay(radius_mm) * np.exp(-1j * self._lag(radius_mm) * np.arange(bins))
            carrier[: len(self._low_wavenumber)] = self._low_carrier(radius_mm)
            table[row] = wave.velocity(frequency_hz, radius_mm, source_radius_mm) * colour / carrier
        self._table = table.view(self._real)

    def evaluate(self, radius_mm: Float64Array) -> NDArray[np.complex128] | NDArray[np.complex64]:
        """Velocity times colour at some distances.

        Parameters
        ----------
        radius_mm : float64 array, shape (distances,)
            Distances in mm, >= 0.

        Returns
        -------
        complex array, shape (distances, bins)
        """
        radius_mm = np.asarray(radius_mm, dtype=np.float64)
        low, high = self._span_mm
        tabulated = (radius_mm >= low) & (radius_mm <= high)
        held_mm = np.where(tabulated, radius_mm, high)
        result: NDArray[np.complex128] | NDArray[np.complex64] = self._carrier(held_mm)
        result *= (self._interpolation(held_mm) @ self._table).view(self._complex)
        for row in np.flatnonzero(~tabulated):
            frequency_hz = self._step_hz * np.arange(self._bins)
            result[row] = self._colour * self._wave.velocity(frequency_hz, radius_mm[row], self._source_radius_mm)
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

    def _carrier(self, radius_mm: Float64Array) -> NDArray[np.complex128] | NDArray[np.complex64]:
        """The carrier on the grid, its plain part as an outer product of two short exponentials."""
        carrier = phase_ramp(-self._lag(radius_mm), self._bins, self._complex, self._decay(radius_mm))
        carrier[:, : len(self._low_wavenumber)] = self._low_carrier(radius_mm[:, None])
        return carrier

    def _low_carrier(self, radius_mm: Float64Array | float) -> NDArray[np.complex128]:
        return np.asarray(np.exp(-1j * self._low_wavenumber * radius_mm / 1e3) / np.sqrt(radius_mm))

    def _lag(self, radius_mm: Float64Array | float) -> Float64Array:
        """Phase in radians that one frequency step gains on the way."""
        return np.asarray(2 * np.pi * self._step_hz * radius_mm / (1e3 * self._wave.speed_m_s))

    def _decay(self, radius_mm: Float64Array | float) -> Float64Array:
        per_mm = self._wave.damping_per_s / (2e3 * self._wave.speed_m_s)
        return np.asarray(np.exp(-per_mm * radius_mm) / np.sqrt(radius_mm))


def phase_ramp(
    radians_per_bin: Float64Array,
    bins: int,
    dtype: ComplexType,
    amplitude: Float64Array | float = 1.0,
) -> NDArray[np.complex128] | NDArray[np.complex64]:
    """Amplitude * exp(j * bin * radians_per_bin), from two short float64 exponentials a row.

    Parameters
    ----------
    radians_per_bin : float64 array, shape (rows,)
        Phase step of each row in radians.
    bins : int
        Number of bins, > 0.
    dtype : numpy type
        complex64 or complex128.
    amplitude : float64 array, shape (rows,), or float
        Factor of each row.

    Returns
    -------
    complex array, shape (rows, bins)
    """
    blocks = -(-bins // PHASE_BLOCK)
    step = np.asarray(radians_per_bin, dtype=np.float64)[:, None]
    scale = np.broadcast_to(np.asarray(amplitude, dtype=np.float64), (len(step),))[:, None]
    coarse = (scale * np.exp(1j * step * (PHASE_BLOCK * np.arange(blocks)))).astype(dtype)
    fine = np.exp(1j * step * np.arange(PHASE_BLOCK)).astype(dtype)
    ramp: NDArray[np.complex128] | NDArray[np.complex64] = coarse[:, :, None] * fine[:, None, :]
    ramp = ramp.reshape(len(step), -1)
    return ramp[:, :bins]
