"""Plates that are none of the product's, and that no constant was chosen on: responses by formula or finite elements.

Each gives mobilities (places, actuators, frequencies) at any frequencies, and with them FIRs.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import scipy.special

MIRRORED_MM = np.array([120.0, 90.0])
DISK_MM = 55.0


def reflected(wavenumber, points_mm, sources_mm, size_mm, reflection, orders):
    """Waves of sources in a rectangle and of their images in its rim, which reflects a part of them."""
    found = 0.0
    for number in np.stack(np.meshgrid(*[np.arange(-orders, orders + 1)] * 2), axis=-1).reshape(-1, 2):
        image_mm = number * size_mm + np.where(number % 2 == 0, 1.0, -1.0) * sources_mm
        apart_mm = np.maximum(np.hypot(*(points_mm[:, None] - image_mm).transpose(2, 0, 1)), 1.0)
        waves = scipy.special.hankel2(0, np.multiply.outer(apart_mm, wavenumber))
        found = found + reflection ** np.abs(number).sum() * waves
    return found


def mirror_images(places_mm, actuator_mm, hertz):
    """A membrane in a rectangle whose edges are held."""
    wave = 2 * np.pi * np.asarray(hertz) / (1e3 * 6.0) / np.sqrt(1 + 0.1j)
    return reflected(wave, np.asarray(places_mm), np.asarray(actuator_mm), MIRRORED_MM, -1.0, 2) * np.asarray(hertz)


def free_disk(wavenumber, points_mm, sources_mm, radius_mm, orders):
    """Point sources in a disk with a free rim: H0 and what the rim adds, order by order (addition theorem)."""
    (r, at), (r0, at0) = ((np.hypot(*some.T), np.arctan2(some[:, 1], some[:, 0])) for some in (points_mm, sources_mm))
    gap_mm = points_mm[:, None] - sources_mm
    distance_mm = np.maximum(np.hypot(gap_mm[..., 0], gap_mm[..., 1]), 1.0)
    found = scipy.special.hankel2(0, wavenumber * distance_mm)
    for order in range(orders + 1):
        slopes = (slope(order, wavenumber * radius_mm) for slope in (scipy.special.h2vp, scipy.special.jvp))
        added = -scipy.special.jv(order, wavenumber * r0) * np.divide(*slopes) * (2 if order else 1)
        turn = np.cos(order * (at[:, None] - at0))
        found = found + scipy.special.jv(order, wavenumber * r)[:, None] * added * turn
    return found


def lattice(spacing_mm, radius_mm):
    """Places of a square lattice within a circle, none of them in its middle."""
    count = int(radius_mm / spacing_mm) + 1
    side = np.arange(-count, count + 1) * spacing_mm + 0.3
    points = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    return points[np.hypot(*points.T) < radius_mm]


@cache
def _bessel_zeros(orders, zeros):
    return np.array([(order, zero) for order in range(orders) for zero in scipy.special.jn_zeros(order, zeros)]).T


def disk(places_mm, actuator_mm, hertz, *, speed_m_s=7.0, loss=0.05, radius_mm=DISK_MM, modes=(18, 9)):
    """A membrane in a fixed ring: its modes are Bessel functions."""
    omega, (order, zero) = 2 * np.pi * np.asarray(hertz), _bessel_zeros(*modes)
    (r, angle), (r0, angle0) = (
        (np.hypot(*np.transpose(some))[:, None] / radius_mm, np.arctan2(some[:, 1], some[:, 0])[:, None])
        for some in (np.asarray(places_mm), np.asarray(actuator_mm))
    )
    shape, source = scipy.special.jv(order, zero * r), scipy.special.jv(order, zero * np.minimum(r0, 0.98))
    around = np.cos(order * (angle[:, None] - angle0)) * np.where(order > 0, 2, 1)
    norm = scipy.special.jv(order + 1, zero) ** 2
    natural = (zero * speed_m_s / (radius_mm / 1e3))[:, None]
    return (shape[:, None] * source * around / norm) @ (1j * omega / (natural**2 * (1 + 1j * loss) - omega**2))


@cache
def _element_modes():
    """Basis, squared wave numbers and shapes of the lowest modes of a quadrilateral without symmetry, in metres."""
    import scipy.sparse.linalg
    import skfem
    from skfem.models.poisson import laplace, mass

    mesh = skfem.MeshTri.init_sqsymmetric().refined(3)
    x, y = mesh.p
    bent = np.stack([0.17 * x * (1 - 0.2 * y) - 0.08, 0.13 * y * (1 + 0.15 * x) - 0.07])
    basis = skfem.Basis(skfem.MeshTri(bent, mesh.t), skfem.ElementTriP2())
    stiffness, inertia = (skfem.asm(form, basis).tocsc() for form in (laplace, mass))
    values, vectors = scipy.sparse.linalg.eigsh(stiffness, 90, inertia, sigma=-1.0)
    return basis, np.maximum(values, 1e-9), vectors


def elements(places_mm, actuator_mm, hertz):
    """A free membrane of another shape by finite elements (scikit-fem), its lowest modes."""
    basis, values, vectors = _element_modes()
    omega = 2 * np.pi * np.asarray(hertz)
    shapes, sources = (basis.probes(np.asarray(some).T / 1e3) @ vectors for some in (places_mm, actuator_mm))
    return (shapes[:, None] * sources) @ (1j * omega / (6.5**2 * values[:, None] * (1 + 0.06j) - omega**2))


def places(kind, spacing_mm):
    """A grid that fits into the plate of this kind, and ten actuators near its edge."""
    reach_mm = {"images": MIRRORED_MM / 2 - 12, "disk": np.full(2, DISK_MM - 10), "elements": np.array([54.0, 42.0])}
    across, up = (spacing_mm * np.arange(-(reach // spacing_mm), reach // spacing_mm + 1) for reach in reach_mm[kind])
    grid = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
    turns = 2 * np.pi * (np.arange(10) + 0.3) / 10
    rim = {"images": MIRRORED_MM / 2 - 6, "disk": np.full(2, DISK_MM - 5), "elements": np.array([60.0, 47.0])}[kind]
    actuator_mm = np.stack([np.cos(turns), np.sin(turns)], axis=1) * rim
    if kind == "disk":
        grid = grid[np.hypot(*grid.T) < DISK_MM - 10]
    return grid, actuator_mm


MAKERS = {"images": mirror_images, "disk": disk, "elements": elements}


def responses(kind, places_mm, actuator_mm, rate_hz, taps, band_hz):
    """FIRs (places, actuators, taps) of a band, with a little room before the wave for what the band rings ahead."""
    hertz = np.fft.rfftfreq(taps, 1 / rate_hz)
    octaves = np.log2(np.maximum(hertz, 1.0) / np.array(band_hz)[:, None])
    window = 0.5 + 0.5 * np.cos(np.pi * np.clip(np.maximum(-octaves[0], octaves[1]) / 0.3, 0, 1))
    used = window > 0
    spectra = np.zeros((len(places_mm), len(actuator_mm), len(hertz)), complex)
    spectra[..., used] = MAKERS[kind](places_mm, actuator_mm, hertz[used]) * window[used]
    spectra[..., used] *= np.exp(-2j * np.pi * hertz[used] * 0.1 * taps / rate_hz)
    green = np.fft.irfft(spectra, taps)
    return green / np.sqrt(np.mean(np.square(green)))


class WaveTravel(NamedTuple):
    group_velocity_m_s: float
    attenuation_db_per_cm: float


def impulse_travel(wave, band_hz=(50.0, 450.0), span_mm=(10.0, 50.0)):
    """Of an impulse with a flat spectrum in the band, its spreading removed: exp(-j k r).

    The velocity is the distance over the delay between the centroids of energy at the two ends of the span; the
    attenuation is the loss of energy between them.
    """
    frequency_hz = np.linspace(*band_hz, 401)
    k = wave.wavenumber(frequency_hz)
    damped = 4 * np.pi * frequency_hz - 1j * wave.damping_per_s
    slowness = (damped / (2 * k * wave.speed_m_s**2)).real
    near_m, far_m = np.array(span_mm) / 1e3
    near, far = (np.exp(2 * k.imag * distance_m) for distance_m in (near_m, far_m))
    delay_s = far_m * np.average(slowness, weights=far) - near_m * np.average(slowness, weights=near)
    loss_db = 10 * np.log10(near.sum() / far.sum())
    return WaveTravel((far_m - near_m) / delay_s, loss_db / (100 * (far_m - near_m)))
