"""Soft plates without a rim: scalar damped waves that leave a small source, and a solid.

The plate "solid" is an elastic solid in plane strain: the paper's eq. (3), with moduli that are complex.

-rho w^2 u = mu laplacian(u) + (K + mu / 3) grad(div u) + f for time as exp(+j w t). Its Green's tensor is

    G = [g_s I + grad grad (g_s - g_p) / k_s^2] / mu,    g = -j/4 H0(2)(k r),

with k_s^2 = rho w^2 / mu and k_p^2 = rho w^2 / (K + 4 mu / 3) (Eringen and Suhubi 1975, section 5.10). In plane polar
coordinates G = A I + B n n, n the unit vector from the actuator; A and B have a part that travels with either wave.

The gel relaxes (Maxwell): every modulus is its instantaneous value times 1 / (1 - j b / w), so that k^2 = (w^2 - j w b)
/ c^2 for both waves, which is the damped wave of the scalar plate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from wavefocus.config.emulation import GEL_PRESSURE_SPEED_M_S, GEL_SPEED_M_S
from wavefocus.config.outline import Outline
from wavefocus.mocks.plates import (
    MAGNET_RADIUS_MM,
    PLATES,
    UNCHANGED,
    Chain,
    Complex128Array,
    Float64Array,
    PlateChange,
)
from wavefocus.mocks.plates.infinite import InfinitePlate


@dataclass(frozen=True, slots=True)
class DampedWave:
    """An infinite soft plate: a scalar wave whose loss is proportional to velocity.

    Time runs as exp(+j w t), so an outgoing wave has Im k < 0:
    k^2 = (w^2 - j w b) / c^2.

    speed_m_s: Speed c of the wave's front in m/s, > 0.
    damping_per_s: Damping b in 1/s, >= 0.
    """

    speed_m_s: float
    damping_per_s: float

    def changed(self, change: PlateChange) -> DampedWave:
        """The wave with speed and damping changed."""
        return DampedWave(self.speed_m_s * change.speed, self.damping_per_s * change.loss)

    def wavenumber(self, frequency_hz: ArrayLike, /) -> Complex128Array:
        """Complex wavenumber in rad/m, Im k <= 0.

        frequency_hz, float array: Frequencies in Hz, >= 0.
        """
        angular = 2 * np.pi * np.asarray(frequency_hz, dtype=np.float64)
        # The principal root of a number in the lower half plane has Im <= 0: the outgoing wave.
        root_of = np.sqrt(angular * angular - 1j * angular * self.damping_per_s)
        return np.asarray(root_of / self.speed_m_s, dtype=np.complex128)

    def velocity(
        self, frequency_hz: ArrayLike, radius_mm: ArrayLike, source_radius_mm: float = MAGNET_RADIUS_MM
    ) -> Complex128Array:
        """Surface velocity at a distance from a disc that pushes with unit force.

        j w * (-j/4) * <H0(2)(k r)>, the mean taken over the disc; the scale is arbitrary. Raises ValueError.

        frequency_hz, float array: Frequencies in Hz, >= 0; broadcast against `radius_mm`. At 0 Hz the velocity is 0.
        radius_mm, float array: Distances from the centre of the disc in mm, >= 0.
        source_radius_mm: Radius of the disc in mm, > 0.
        """
        frequency = np.asarray(frequency_hz, dtype=np.float64)
        still = frequency == 0
        wavenumber = self.wavenumber(np.where(still, 1.0, frequency))
        mean = mean_hankel(wavenumber, np.asarray(radius_mm) / 1e3, source_radius_mm / 1e3)
        return np.asarray(np.where(still, 0.0, 0.5 * np.pi * frequency * mean), dtype=np.complex128)

    def kernels(self, frequency_hz: Float64Array, radius_mm: float, source_radius_mm: float) -> Complex128Array:
        """The velocity as one kernel, (1, frequencies)."""
        return self.velocity(frequency_hz, radius_mm, source_radius_mm)[None]


def mean_hankel(wavenumber: ArrayLike, radius_m: ArrayLike, source_radius_m: float) -> Complex128Array:
    """Mean of H0(2)(k |r - s|) over the points s of a disc: finite at r = 0.

    Graf's addition theorem: outside the disc H0(2)(k r) 2 J1(k a) / (k a); inside it
    (2 / (k a)) J0(k r) H1(2)(k a) - 4j / (pi (k a)^2). Raises ValueError.

    wavenumber, complex array: k in rad/m, not 0, Im k <= 0; broadcast against `radius_m`.
    radius_m, float array: Distances from the centre of the disc in m, >= 0.
    source_radius_m: Radius a of the disc in m, > 0.
    """
    k, r = np.broadcast_arrays(np.asarray(wavenumber, dtype=np.complex128), np.asarray(radius_m, dtype=np.float64))
    a = float(source_radius_m)
    if np.any(k.imag > 0):
        raise ValueError(
            f"wavenumber has an imaginary part of {k.imag.max()} rad/m; it must not be positive, "
            "for the wave would grow as it travels"
        )
    mean = np.empty(k.shape, dtype=np.complex128)
    outside = r >= a
    ka = k[outside] * a
    mean[outside] = scipy.special.hankel2(0, k[outside] * r[outside]) * 2 * scipy.special.jv(1, ka) / ka
    inside = ~outside
    ka = k[inside] * a
    mean[inside] = 2 / ka * scipy.special.jv(0, k[inside] * r[inside]) * scipy.special.hankel2(1, ka) - 4j / (
        np.pi * ka * ka
    )
    return mean


SOFT_PLATE = DampedWave(speed_m_s=GEL_SPEED_M_S, damping_per_s=421.33369835)
"""The paper's impulses (section IV.A) travel on it: by test_plates.py 4.8 m/s and 3.8 dB/cm in 50 to 450 Hz."""

UNIT_FORCE_N = 1000.0 * SOFT_PLATE.speed_m_s**2 * 0.013
"""rho c^2 h: what a unit force on the scalar plate stands for; 13 mm thick (the paper, section III), dense as water."""


@PLATES.register
class SoftPlate(InfinitePlate):
    """A gel plate without a rim, fitted to the paper's group velocity and attenuation."""

    name = "soft"
    unit_force_n = UNIT_FORCE_N

    def __init__(
        self, actuator_mm: Float64Array, outline: Outline, chain: Chain, *, change: PlateChange = UNCHANGED
    ) -> None:
        super().__init__(actuator_mm, outline, change.softened(chain), (SOFT_PLATE.changed(change),))


@dataclass(frozen=True, slots=True)
class _SolidWave(DampedWave):
    """Shear or pressure wave of the solid.

    shear_speed_m_s: Speed of the solid's shear wave.
    is_shear: Whether this is that wave.
    """

    shear_speed_m_s: float
    is_shear: bool

    def kernels(self, frequency_hz: Float64Array, radius_mm: float, source_radius_mm: float) -> Complex128Array:
        """Parts of A and B that travel with this wave, for a force spread over a disk: j w (rho c_s^2) G.

        Each is a cylinder function times the mean of J0 over the disk; within the disk J and H change places.
        """
        frequency = np.asarray(frequency_hz, dtype=np.float64)
        still = frequency == 0
        angular = 2 * np.pi * np.where(still, 1.0, frequency)
        k = self.wavenumber(angular / (2 * np.pi))
        z, a = k * radius_mm / 1e3, k * source_radius_mm / 1e3
        if radius_mm >= source_radius_mm:
            zero, one, two = (2 * scipy.special.jv(1, a) / a * scipy.special.hankel2(order, z) for order in range(3))
            one = one / z
        else:
            mean = 2 * scipy.special.hankel2(1, a) / a
            zero, two = mean * scipy.special.jv(0, z) - 4j / (np.pi * a * a), mean * scipy.special.jv(2, z)
            # J1(z) / z, finite at the centre.
            one = mean * (scipy.special.jv(0, z) + scipy.special.jv(2, z)) / 2
        if self.is_shear:
            kernels = np.stack([zero - one, two])
        else:
            kernels = (self.shear_speed_m_s / self.speed_m_s) ** 2 * np.stack([one, -two])
        softness = (1j * angular + self.damping_per_s) * -0.25j
        return np.asarray(np.where(still, 0.0, softness * kernels))


@PLATES.register
class SolidPlate(InfinitePlate):
    """A gel without a rim that moves in its plane: g^{alpha beta} for one direction of force and one of oscillation.

    actuator_mm, outline, chain: See `Plate`.
    shear_speed_m_s, pressure_speed_m_s: Speeds of the fronts of both waves, which `PlateKeys` checks.
    damping_per_s: Rate b of relaxation, >= 0.
    force_deg, oscillation_deg: Direction in which every actuator pushes, and in which the velocity is seen, from x
        towards y.
    """

    name = "solid"

    def __init__(
        self,
        actuator_mm: Float64Array,
        outline: Outline,
        chain: Chain,
        *,
        shear_speed_m_s: float = GEL_SPEED_M_S,
        pressure_speed_m_s: float = GEL_PRESSURE_SPEED_M_S,
        damping_per_s: float = SOFT_PLATE.damping_per_s,
        force_deg: float = 0.0,
        oscillation_deg: float = 0.0,
        change: PlateChange = UNCHANGED,
    ) -> None:
        self.unit_force_n = UNIT_FORCE_N * (shear_speed_m_s / SOFT_PLATE.speed_m_s) ** 2
        shear, pressure = change.speed * shear_speed_m_s, change.speed * pressure_speed_m_s
        loss = change.loss * damping_per_s
        waves = _SolidWave(shear, loss, shear, is_shear=True), _SolidWave(pressure, loss, shear, is_shear=False)
        super().__init__(actuator_mm, outline, change.softened(chain), waves)
        self._force, self._oscillation = (
            np.array([np.cos(angle), np.sin(angle)]) for angle in np.radians([force_deg, oscillation_deg])
        )

    def weights(self, gap_mm: Float64Array) -> Float64Array:
        length = np.hypot(*gap_mm.T)[:, None]
        outward = gap_mm / np.where(length > 0, length, 1.0)
        across = np.full(len(gap_mm), self._force @ self._oscillation)
        return np.stack([across, (outward @ self._force) * (outward @ self._oscillation)], axis=1)
