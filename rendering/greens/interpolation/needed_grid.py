"""Grid spacing that a band needs, from the wave number and the interpolation alone.

Waves of one complex wave number arrive from all sides. Their covariance has a closed form
(`wavefocus.calibration.wave_model`), and so has the expected error of an interpolation with given weights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np

from wavefocus.calibration.wave_model import PatchKernel, WaveModel, disk_integral, plane_waves
from wavefocus.rendering.arrays import Complex128Array, Float64Array
from wavefocus.rendering.greens.interpolation.base import NEIGHBOURS, GridInterpolation, interpolation_method
from wavefocus.rendering.greens.interpolation.on_grid import LatticeInterpolation
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.storage.errors import InputError

Lattice = Literal["square", "hexagonal"]

PLACES_PER_SPACING = 8
"""Places across a grid cell over which the error is averaged."""
TRUSTED_SHARE = 0.01
"""Share of the disk's kernel where waves are trusted to be what they seem; 1 where only their length is."""
LEAST_RIDGE = 1e-6
LARGEST_RADIANS_MM = 1e12
MOST_NEPERS_PER_RADIAN = 10.0
SCANNED_RADIANS = np.geomspace(0.005, 6.0, 96)
BISECTIONS = 16


@dataclass(frozen=True, slots=True)
class NeededGrid:
    """A grid that is close enough.

    spacing_mm: Largest distance of neighbouring positions that keeps to the error.
    positions: Number that covers the area.
    error: Expected relative error at that spacing.
    """

    lattice: Lattice
    spacing_mm: float
    positions: int
    error: float


def wave_number_rad_mm(frequency_hz: float, speed_m_s: float, attenuation_db_per_cm: float = 0.0) -> complex:
    """Wave number k of a wave exp(-j k r), Im k <= 0, from its phase speed and its loss.

    Raises InputError: a figure is out of range.
    """
    for name, value, low in (("frequency_hz", frequency_hz, 0.0), ("speed_m_s", speed_m_s, 0.0)):
        if not (math.isfinite(value) and value > low):
            raise InputError(f"{name} is {value}; it must be a finite number above 0")
    if not (math.isfinite(attenuation_db_per_cm) and attenuation_db_per_cm >= 0):
        raise InputError(f"attenuation_db_per_cm is {attenuation_db_per_cm}; it must be a finite number, 0 or above")
    nepers_mm = attenuation_db_per_cm * math.log(10.0) / 20.0 / 10.0
    radians_mm = 2.0 * math.pi * frequency_hz / (1e3 * speed_m_s)
    if not 1.0 / LARGEST_RADIANS_MM < radians_mm < LARGEST_RADIANS_MM:
        raise InputError(
            f"speed_m_s is {speed_m_s:g}; at {frequency_hz:g} Hz the wavelength must be between 1e-11 and 1e12 mm"
        )
    if nepers_mm > MOST_NEPERS_PER_RADIAN * radians_mm:
        raise InputError(
            f"attenuation_db_per_cm is {attenuation_db_per_cm:g}; at {frequency_hz:g} Hz the waves end within a"
            " fraction of their wavelength, and no grid samples them"
        )
    return complex(radians_mm, -nepers_mm)


def needed_grid(
    wavenumber_rad_mm: complex,
    area_mm2: float,
    error: float,
    *,
    lattice: Lattice = "square",
    kind: str = "kernel",
    noise_db: float = -60.0,
    trusted: bool = False,
) -> NeededGrid:
    """Find the widest grid whose interpolation keeps to an error.

    Raises InputError: a figure is out of range, or no grid keeps to the error.
    """
    if not (0.0 < error < 1.0):
        raise InputError(f"the interpolation error allowed is {error}; it must be between 0 and 1")
    if not (math.isfinite(area_mm2) and area_mm2 > 0):
        raise InputError(f"the area to be covered is {area_mm2} mm2; it must be a finite number above 0")

    def error_at(radians: float) -> float:
        spacing_mm = radians / wavenumber_rad_mm.real
        return expected_error(
            wavenumber_rad_mm, spacing_mm, lattice=lattice, kind=kind, noise_db=noise_db, trusted=trusted
        )

    low, high, least = 0.0, math.inf, math.inf
    # From the first spacing that is enough on; very close grids of a noisy bank may be worse than wider ones.
    for radians in SCANNED_RADIANS.tolist():
        found = error_at(radians)
        least = min(least, found)
        if found <= error:
            low = radians
        elif low:
            high = radians
            break
    if not low:
        raise InputError(
            f"no grid keeps interpolation {kind!r} within {100 * error:.3g} %: {100 * least:.2g} % is the"
            f" least that a bank with an error of {noise_db:g} dB allows"
        )
    for _ in range(BISECTIONS if math.isfinite(high) else 0):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if error_at(middle) <= error else (low, middle)
    spacing_mm = low / wavenumber_rad_mm.real
    cell_mm2 = spacing_mm**2 * (1.0 if lattice == "square" else math.sqrt(3.0) / 2.0)
    return NeededGrid(lattice, spacing_mm, math.ceil(area_mm2 / cell_mm2), error_at(low))


def expected_error(
    wavenumber_rad_mm: complex,
    spacing_mm: float,
    *,
    lattice: Lattice = "square",
    kind: str = "kernel",
    noise_db: float = -60.0,
    trusted: bool = False,
) -> float:
    """Expected relative rms error between the positions of a wide grid, averaged over a cell.

    Raises InputError: a figure is out of range, or the kind does not go with the lattice.
    """
    if not (wavenumber_rad_mm.real > 0 and wavenumber_rad_mm.imag <= 0 and np.isfinite(wavenumber_rad_mm)):
        raise InputError(f"the wave number is {wavenumber_rad_mm} rad/mm; it must be finite, Re k > 0 and Im k <= 0")
    if not (math.isfinite(spacing_mm) and spacing_mm > 0):
        raise InputError(f"spacing_mm is {spacing_mm}; it must be a finite number above 0")
    # The kernel's own class loads SciPy; its weights are here.
    method = None if kind == "kernel" else interpolation_method(kind)
    if method and issubclass(method, LatticeInterpolation) and lattice == "hexagonal":
        raise InputError(f"interpolation {kind!r} goes with a square grid alone; use 'nearest' or 'kernel'")
    noise = 10.0 ** (noise_db / 10.0)
    position_mm = spacing_mm * _rings(lattice)
    places_mm = spacing_mm * _cell(lattice)
    wavenumber = np.array([wavenumber_rad_mm])
    if method and issubclass(method, GridInterpolation):
        weights = _grid_weights(method, lattice)
    else:
        share, ridge = (TRUSTED_SHARE if trusted else 1.0), max(noise, LEAST_RIDGE)
        model = WaveModel(np.ones(1), wavenumber, np.array([share]), np.array([ridge]))
        weights = PatchKernel(model, position_mm, disk_integral).weights(places_mm)[0]
    # Relative to the first position, so that the damped waves' strength is that of the middle.
    waves = plane_waves(wavenumber, np.concatenate([position_mm, places_mm]))[0]
    measured, wanted = waves[: len(position_mm)], waves[len(position_mm) :]
    wrong = np.square(np.abs(wanted - weights @ measured)).mean(axis=1)
    wrong += noise * np.square(np.abs(weights)).sum(axis=1)
    return float(np.sqrt(np.mean(wrong / np.square(np.abs(wanted)).mean(axis=1))))


@cache
def _grid_weights(method: type[GridInterpolation], lattice: Lattice) -> Complex128Array:
    """Weights (places, positions) of an interpolation that looks at the places alone: the same at any spacing."""
    position, places = _rings(lattice), _cell(lattice)
    nodes = method(PositionGrid(position)).nodes(places)
    weights = np.zeros((len(places), len(position)), dtype=np.complex128)
    np.add.at(weights, (np.arange(len(places))[:, None], nodes.rows), nodes.weights)
    return weights


@cache
def _rings(lattice: Lattice) -> Float64Array:
    """A position and its 36 neighbours at spacing 1."""
    steps = np.arange(-6, 7)
    x, y = (part.ravel().astype(np.float64) for part in np.meshgrid(steps, steps))
    if lattice == "hexagonal":
        x, y = x + 0.5 * y, math.sqrt(0.75) * y
    nearest = np.lexsort((np.arctan2(y, x), np.round(np.hypot(x, y), 9)))[: NEIGHBOURS + 1]
    return np.stack([x[nearest], y[nearest]], axis=1)


@cache
def _cell(lattice: Lattice) -> Float64Array:
    """Places evenly over the cell of the middle position: those that no other is nearer to."""
    side = (np.arange(PLACES_PER_SPACING * 2) + 0.5) / PLACES_PER_SPACING - 1.0
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    distance = np.hypot(*(places[:, None] - _rings(lattice)).transpose(2, 0, 1))
    return np.asarray(places[np.argmin(distance, axis=1) == 0])
