"""Waves as a bank shows them, and the kernel that follows.

A field without sources nearby is a sum of damped plane waves exp(-j k d.x) from all directions d, with the
medium's complex wave number k. What such sums have in common is the covariance

    (1 - s) mean_d exp(-j k d.x) conj(exp(-j k d.y))  +  s 2 J1(a |k| r) / (a |k| r),    r = |x - y|.

The first term holds the waves; the second is the kernel of the disk of wave numbers up to a |k| (a = 1.15),
which holds whatever else the medium does within it. The share s, the wave number and the ridge (noise over
signal, as power) come from the bank, by leaving positions out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]
Complex128Array = NDArray[np.complex128]
Disk = Callable[[Float64Array], Float64Array]

DISK_RADIUS = 1.15
"""Radius a of the disk, in wave numbers: room for what the damping smears."""
FEWEST_DIRECTIONS = 16
LARGEST_GROWTH = 8.0
"""Nepers over a patch beyond which damping says no more: the far side does not reach this one."""


@dataclass(frozen=True, slots=True)
class WaveModel:
    """Waves at some frequencies.

    frequency_hz, float64 (frequencies,): Ascending.
    wavenumber_rad_mm, complex128 (frequencies,): Re k > 0, Im k <= 0, in radians per millimetre.
    disk_share, float64 (frequencies,): Share s of the disk's kernel, above 0 and at most 1.
    ridge, float64 (frequencies,): Added to the covariance of a position with itself, > 0.
    """

    frequency_hz: Float64Array
    wavenumber_rad_mm: Complex128Array
    disk_share: Float64Array
    ridge: Float64Array

    def at(self, frequency_hz: Float64Array) -> WaveModel:
        """The waves at other frequencies: between them, smooth in the logarithm; beyond, one phase speed."""
        held = np.clip(frequency_hz, self.frequency_hz[0], self.frequency_hz[-1])
        known, wanted = np.log(self.frequency_hz), np.log(held)
        parts = np.stack([np.log(self.wavenumber_rad_mm.real), self.wavenumber_rad_mm.imag], axis=1)
        from scipy.interpolate import PchipInterpolator  # slow to load; a grid is planned at one frequency

        # Smooth, for the kernel feels a few thousandths of the wave number; and never beyond its neighbours' values.
        parts = PchipInterpolator(known, parts)(wanted) if len(known) > 1 else np.repeat(parts, len(wanted), axis=0)
        # Below 1e-3 of the first frequency nothing travels; the floor keeps the kernel's argument from 0.
        real, imaginary = np.exp(parts[:, 0]) * np.maximum(frequency_hz / held, 1e-3), parts[:, 1]
        share, ridge = (np.exp(np.interp(wanted, known, np.log(part))) for part in (self.disk_share, self.ridge))
        return WaveModel(np.asarray(frequency_hz, dtype=np.float64), real + 1j * imaginary, share, ridge)


class PatchKernel:
    """The regression from the positions of one patch.

    model: Waves at the frequencies wanted.
    offset_mm, float64 (n, 2): Positions relative to the first.
    disk: `disk_kernel` or `disk_integral`.

    inverse, complex128 (frequencies, n, n): Of the covariance among the positions, ridge included.
    """

    def __init__(self, model: WaveModel, offset_mm: Float64Array, disk: Disk | None = None) -> None:
        self._offset_mm, self._disk = offset_mm, disk or disk_kernel
        self._share = model.disk_share[:, None, None]
        self._wavenumber, self._directions = _resolved(model.wavenumber_rad_mm, offset_mm)
        self._waves = self._plane_waves(offset_mm)
        covariance = self._covariance(self._waves, offset_mm, self._waves, offset_mm)
        diagonal = np.arange(len(offset_mm))
        covariance[:, diagonal, diagonal] += model.ridge[:, None]
        self.inverse: Complex128Array = np.asarray(np.linalg.inv(covariance), dtype=np.complex128)

    def weights(self, points_mm: Float64Array) -> Complex128Array:
        """Weights w of the positions, the value at a point being sum_n w_n g_n.

        points_mm, float64 (points, 2): Places relative to the patch's first position.

        Returns complex128 (frequencies, points, n).
        """
        across = self._covariance(self._plane_waves(points_mm), points_mm, self._waves, self._offset_mm)
        return np.asarray(across @ self.inverse)

    def variance(self, points_mm: Float64Array) -> Float64Array:
        """Expected square of the error at points, for fields of the kernel's own strength, (frequencies, points)."""
        waves = self._plane_waves(points_mm)
        across = self._covariance(waves, points_mm, self._waves, self._offset_mm)
        own = (1.0 - self._share[..., 0]) * np.mean(np.square(np.abs(waves)), axis=2) + self._share[..., 0]
        explained = np.einsum("fpn,fpn->fp", across @ self.inverse, across.conj()).real
        return np.asarray(np.maximum(own - explained, 0.0))

    @property
    def left_out(self) -> Complex128Array:
        """What turns the patch's values into the error at the first position, left out: (frequencies, n).

        Closed form: with C the covariance, ridge included, the error is (C^-1 g)_0 / (C^-1)_00.
        """
        return np.asarray(self.inverse[:, 0] / self.inverse[:, :1, 0].real)

    @property
    def left_out_variance(self) -> Float64Array:
        """Expected square of that error, noise included, for fields of the kernel's own strength: (frequencies,)."""
        return np.asarray(1.0 / self.inverse[:, 0, 0].real)

    def _plane_waves(self, points_mm: Float64Array) -> Complex128Array:
        return _plane_waves(self._wavenumber, self._directions, points_mm)

    def _covariance(
        self, waves: Complex128Array, points_mm: Float64Array, others: Complex128Array, others_mm: Float64Array
    ) -> Complex128Array:
        ring, disk = _parts(self._wavenumber, waves, points_mm, others, others_mm, self._disk)
        return np.asarray((1.0 - self._share) * ring + self._share * disk)


def plane_waves(wavenumber_rad_mm: Complex128Array, offset_mm: Float64Array) -> Complex128Array:
    """Waves from all directions at the positions of a patch.

    wavenumber_rad_mm, complex128 (frequencies,): Re k > 0, Im k <= 0.
    offset_mm, float64 (n, 2): Positions relative to where a wave's amplitude is 1.

    Returns complex128 (frequencies, n, directions): the mean over the directions is that over all directions, to
    rounding.
    """
    return _plane_waves(*_resolved(wavenumber_rad_mm, offset_mm), offset_mm)


def kernel_parts(wavenumber_rad_mm: Complex128Array, offset_mm: Float64Array) -> tuple[Complex128Array, Float64Array]:
    """The two terms of the covariance among the positions of a patch.

    wavenumber_rad_mm, complex128 (frequencies,): Re k > 0, Im k <= 0.
    offset_mm, float64 (n, 2) or (patches, n, 2): Positions relative to the first; several patches at one frequency
        only.

    Returns waves : complex128 (frequencies or patches, n, n); disk : float64 (frequencies or patches, n, n).
    """
    wavenumber, directions = _resolved(wavenumber_rad_mm, offset_mm)
    waves = _plane_waves(wavenumber, directions, offset_mm)
    return _parts(wavenumber, waves, offset_mm, waves, offset_mm, disk_kernel)


def disk_kernel(radians: Float64Array) -> Float64Array:
    """2 J1(z) / z, the covariance of fields whose wave numbers fill a disk; 1 at 0."""
    from scipy.special import j1  # slow to load; a grid is planned with `disk_integral`

    safe = np.maximum(np.abs(radians), 1e-8)
    return np.asarray(2.0 * j1(safe) / safe)


def disk_integral(radians: Float64Array) -> Float64Array:
    """`disk_kernel` by Poisson's integral, the mean of ``2 sin(t)^2 cos(z cos(t))``, without SciPy, to 1e-12.

    Meant for lattices, on which few distances differ: each is integrated once.
    """
    different, inverse = np.unique(np.round(np.abs(radians), 12), return_inverse=True)
    # The trapezoidal rule over a half turn errs by the Bessel functions of orders above twice its points.
    count = int(np.ceil(0.5 * different[-1])) + 16
    angle = np.pi / 2 * (np.arange(count) + 0.5) / count
    found = np.cos(np.outer(different, np.cos(angle))) @ (2.0 / count * np.square(np.sin(angle)))
    return np.asarray(found[inverse].reshape(radians.shape))


def _resolved(wavenumber_rad_mm: Complex128Array, offset_mm: Float64Array) -> tuple[Complex128Array, Float64Array]:
    """Wave numbers, damped no more than a patch can resolve, and enough directions (2, n) for it."""
    reach_mm = max(float(np.hypot(offset_mm[..., 0], offset_mm[..., 1]).max()), 1e-300)
    wavenumber = wavenumber_rad_mm.real + 1j * np.maximum(wavenumber_rad_mm.imag, -LARGEST_GROWTH / reach_mm)
    # The trapezoidal rule over directions is exact once it resolves exp(j k d.x) across the patch.
    count = 2 * int(np.ceil(np.abs(wavenumber).max() * reach_mm)) + FEWEST_DIRECTIONS
    angle = 2.0 * np.pi * (np.arange(count) + 0.5) / count
    return wavenumber, np.stack([np.cos(angle), np.sin(angle)])


def _plane_waves(
    wavenumber_rad_mm: Complex128Array, directions: Float64Array, points_mm: Float64Array
) -> Complex128Array:
    return np.asarray(np.exp(-1j * wavenumber_rad_mm[:, None, None] * (points_mm @ directions)))


def _parts(
    wavenumber_rad_mm: Complex128Array,
    waves: Complex128Array,
    points_mm: Float64Array,
    others: Complex128Array,
    others_mm: Float64Array,
    disk_of: Disk,
) -> tuple[Complex128Array, Float64Array]:
    gap_mm = points_mm[..., :, None, :] - others_mm[..., None, :, :]
    apart_mm = np.hypot(gap_mm[..., 0], gap_mm[..., 1])
    disk = disk_of(DISK_RADIUS * np.abs(wavenumber_rad_mm)[:, None, None] * apart_mm)
    ring = waves @ others.conj().transpose(0, 2, 1) / waves.shape[2]
    return np.asarray(ring), disk
