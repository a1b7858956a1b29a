"""Which grid a band needs, and the hours that a wider one saves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from acquisition.durations import hours
from calibration.blas import one_blas_thread
from rendering.greens.interpolation.needed_grid import needed_grid, wave_number_rad_mm
from rendering.greens.interpolation.position_grid import PositionGrid

if TYPE_CHECKING:
    from rendering.scene.model import Scene

GEL_SPEED_M_S = 4.8
GEL_ATTENUATION_DB_PER_CM = 3.8
"""A gel plate as in the paper: group velocity about 4.8 m/s, loss about 3.8 dB/cm."""
EMITTED_SHARE = 0.999
"""A scene's band ends where this share of what its signals emit lies below."""
BANK_ERROR_DB = -60.0
KINDS: tuple[tuple[str, Literal["square", "hexagonal"]], ...] = (
    ("bicubic", "square"),
    ("kernel", "square"),
    ("kernel", "hexagonal"),
)


@dataclass(frozen=True, slots=True)
class Waves:
    """What is asked of the interpolation, and the waves that it is for.

    Parameters
    ----------
    error : float
        Relative rms error allowed between the positions at the band's upper end, 0 to 1.
    speed_m_s, attenuation_db_per_cm : float
        Of the plate's waves; by default those of the paper's gel.
    """

    error: float = 0.05
    speed_m_s: float = GEL_SPEED_M_S
    attenuation_db_per_cm: float = GEL_ATTENUATION_DB_PER_CM


@dataclass(frozen=True, slots=True)
class GridAdvice:
    """A grid that is close enough for a band.

    Parameters
    ----------
    interpolation : str
        Between its positions, as a scene names it.
    lattice : {"square", "hexagonal"}
        As a run file names it.
    spacing_mm : float
        Largest distance of neighbouring positions that keeps to the error.
    positions : int
        How many it takes on the area of the plan.
    duration_s : float
        What measuring them takes, at the plan's time per position.
    """

    interpolation: str
    lattice: str
    spacing_mm: float
    positions: int
    duration_s: float


def grid_advice(
    position_mm: NDArray[np.float64],
    position_s: float,
    *,
    top_hz: float,
    waves: Waves,
) -> tuple[GridAdvice, ...]:
    """Find the widest grids that keep the interpolation within an error, on the area that a plan covers.

    Parameters
    ----------
    position_mm : float64 array, shape (positions, 2)
        The plan's grid; its area is positions times spacing squared.
    position_s : float
        Seconds that a position takes.
    top_hz : float
        Upper end of the band in Hz, > 0.
    waves : Waves
        The error allowed, and the plate.

    Raises
    ------
    InputError
        A figure is out of range, or no grid keeps to the error.
    """
    area_mm2 = len(position_mm) * PositionGrid(position_mm).spacing_mm ** 2 or 1.0
    wavenumber = wave_number_rad_mm(top_hz, waves.speed_m_s, waves.attenuation_db_per_cm)
    advice = []
    for kind, lattice in KINDS:
        with one_blas_thread():  # thousands of small matrices
            grid = needed_grid(wavenumber, area_mm2, waves.error, lattice=lattice, kind=kind, noise_db=BANK_ERROR_DB)
        advice.append(GridAdvice(kind, lattice, grid.spacing_mm, grid.positions, grid.positions * position_s))
    return tuple(advice)


def top_hz_of(scenes: Sequence[Scene], sample_rate_hz: float, stop_hz: float) -> float:
    """Upper end of the band that scenes emit: below it lies 99.9 % of their signals' energy.

    Parameters
    ----------
    scenes : sequence of Scene
        At least one.
    sample_rate_hz : float
        Rate of the plan.
    stop_hz : float
        The sweep's upper end; nothing is measured beyond it.
    """
    highest_hz = 0.0
    for scene in scenes:
        for source in scene.sources:
            power = np.square(np.abs(np.fft.rfft(source.signal.samples(sample_rate_hz))))
            upto = np.cumsum(power)
            share = np.searchsorted(upto, EMITTED_SHARE * upto[-1]) / max(len(power) - 1, 1)
            highest_hz = max(highest_hz, float(share) * sample_rate_hz / 2)
    return min(highest_hz, stop_hz) or stop_hz


def advice_lines(advice: Sequence[GridAdvice], *, top_hz: float, waves: Waves, planned_s: float) -> list[str]:
    """The advice for people, a line per grid."""
    lines = [
        f"grid        enough for {100 * waves.error:g} % between the positions at {top_hz:.0f} Hz, "
        f"at {waves.speed_m_s:g} m/s and {waves.attenuation_db_per_cm:g} dB/cm:"
    ]
    for one in advice:
        saved_s = planned_s - one.duration_s
        change = f"{hours(saved_s)} less" if saved_s >= 0 else f"{hours(-saved_s)} more"
        lines.append(
            f"            {one.interpolation}, {one.lattice}, {one.spacing_mm:.1f} mm: {one.positions} positions, "
            f"{hours(one.duration_s)} ({change})"
        )
    return lines
