"""What a bank says that does not change while it fills: grid, actuators, outline, units."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from config.stadium import stadium_rim
from gui.shell.toml_files import is_virtual

if TYPE_CHECKING:
    from gui.surface.raster import Raster
    from storage.bank.reading import Bank

_OUTLINE_POINTS = 181


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A bank without what is measured.

    Parameters
    ----------
    bank : Path
        The file.
    position_mm : float64 array (positions, 2)
        The grid.
    actuator_mm : float64 array (actuators, 2)
        NaN where unknown.
    outline_mm : float64 array (points, 2) or None
        Rim of the surface, closed; None where the bank does not say.
    sample_rate_hz, taps : float, int
        Of the Green's functions.
    band_hz : tuple of float or None
        Measured band.
    unit : str
        Of the Green's functions.
    is_virtual : bool
        Whether it was measured on a virtual rig, by its own words.
    raster : Raster
        Which position each pixel of a picture belongs to.
    """

    bank: Path
    position_mm: NDArray[np.float64]
    actuator_mm: NDArray[np.float64]
    outline_mm: NDArray[np.float64] | None
    sample_rate_hz: float
    taps: int
    band_hz: tuple[float, float] | None
    unit: str
    is_virtual: bool
    raster: Raster

    @property
    def positions(self) -> int:
        """Number of grid positions."""
        return len(self.position_mm)

    @property
    def actuators(self) -> int:
        """Number of actuators."""
        return len(self.actuator_mm)


def surface_of(bank: Bank) -> Surface:
    """Return what an open bank says."""
    from gui.surface.raster import raster_of  # scipy is loaded by whoever opens a bank, not by the window's start

    position_mm = np.asarray(bank.position_mm, np.float64)
    return Surface(
        bank=bank.path,
        position_mm=position_mm,
        actuator_mm=np.asarray(bank.actuator_mm, np.float64),
        outline_mm=_outline_mm(bank.rig_json),
        sample_rate_hz=bank.sample_rate_hz,
        taps=bank.taps,
        band_hz=bank.band_hz,
        unit=bank.response_unit,
        is_virtual=_is_virtual(bank.rig_json),
        raster=raster_of(position_mm),
    )


def _is_virtual(rig_json: str | None) -> bool:
    try:
        rig = json.loads(rig_json or "")
    except ValueError:
        return False
    return isinstance(rig, dict) and "mirror" in rig and is_virtual(rig)


def _outline_mm(rig_json: str | None) -> NDArray[np.float64] | None:
    """The rim by the rig's configuration; a bank made by another program may hold any text there."""
    try:
        surface = json.loads(rig_json or "")["surface"]
        length_mm, width_mm = float(surface["length_mm"]), float(surface["width_mm"])
    except (ValueError, TypeError, KeyError):
        return None
    if surface.get("kind") != "stadium" or not 0 < width_mm <= length_mm < np.inf:
        return None
    rim_mm = stadium_rim(length_mm, width_mm, 0.0, _OUTLINE_POINTS - 1)
    return np.vstack([rim_mm, rim_mm[:1]])
