"""The soft stadium: a gel plate with a rim that reflects, actuators of finite size embedded in its periphery."""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from config.outline import Outline
from mocks.plates import PLATES, UNCHANGED, Change, Complex128Array
from mocks.plates.finite_elements import Elements, RitzModes, Triangles, ritz_modes, spacing_mm, triangulate
from mocks.plates.modal import ALL, ModalPlate, Modes
from mocks.plates.soft import SOFT_PLATE, UNIT_FORCE_N, DampedWave

Float64Array = NDArray[np.float64]

HIGHEST_HZ = 500.0
"""Upper end of the band in which the plate is accurate to 1 %; above, it is a causal plate with fewer modes."""
RECIPE = 1
"""Raised when the same plate is computed in another way, so that no older file is used."""


@PLATES.register
class StadiumPlate(ModalPlate):
    """A soft plate whose rim is free or takes up waves; everything else is the medium of the infinite soft plate.

    Parameters
    ----------
    actuator_mm, outline, chain
        As of every plate.
    rim_admittance : float
        Of the rim, relative to the medium's: 0 is a free edge, 1 takes up what arrives at a right angle.
    """

    name = "stadium"
    unit_force_n = UNIT_FORCE_N

    def __init__(
        self,
        actuator_mm: Float64Array,
        outline: Outline,
        chain: Callable[[Float64Array], Complex128Array],
        *,
        rim_admittance: float = 0.0,
        change: Change = UNCHANGED,
    ) -> None:
        super().__init__(actuator_mm, outline, change.softened(chain))
        self._wave = SOFT_PLATE.changed(change)
        self._elements, self._modes = _cached(actuator_mm, outline, rim_admittance)
        self._pairs = _damped_pairs(self._modes, self._wave, rim_admittance) if rim_admittance else None

    def coefficients(self, place_mm: Float64Array, modes: Modes = ALL) -> Float64Array:
        shapes = self._elements.values_at(place_mm, self._modes.shapes)
        if self._pairs is None:
            return np.asarray(shapes[:, None, modes] * self._modes.force.T[:, modes])
        part = (shapes @ self._pairs.shapes)[:, None, :] * self._pairs.force.T
        return np.concatenate([part.real, part.imag], axis=-1)[..., modes]

    def mode_velocities(self, frequency_hz: Float64Array) -> Complex128Array:
        angular = 2 * np.pi * np.asarray(frequency_hz, dtype=np.float64)
        if self._pairs is None:
            # j w / (k_mode^2 - k^2); at 0 Hz nothing moves.
            gap = self._modes.stiffness[:, None] - np.square(self._wave.wavenumber(frequency_hz))
            return np.asarray(np.divide(1j * angular, gap, out=np.zeros_like(gap), where=angular > 0))
        first = 1 / (1j * angular - self._pairs.rate_per_s[:, None])
        second = 1 / (1j * angular - self._pairs.rate_per_s[:, None].conj())
        return np.concatenate([first + second, 1j * (first - second)])


@dataclass(frozen=True, slots=True)
class _DampedPairs:
    """Modes of a damped rim, one of each conjugate pair: (pairs,), (modes, pairs) and (pairs, actuators)."""

    rate_per_s: Complex128Array
    shapes: Complex128Array
    force: Complex128Array


def _damped_pairs(modes: RitzModes, wave: DampedWave, admittance: float) -> _DampedPairs:
    from scipy.linalg import eig, solve

    speed, count = wave.speed_m_s, len(modes.stiffness)
    system = np.zeros((2 * count, 2 * count))
    system[:count, count:] = np.eye(count)
    system[count:, :count] = -(speed**2) * np.diag(modes.stiffness)
    system[count:, count:] = -wave.damping_per_s * np.eye(count) - speed * admittance * modes.rim
    rate, shape = eig(system)
    force = np.concatenate([np.zeros_like(modes.force), speed**2 * modes.force])
    reached = solve(shape, force.astype(np.complex128))
    kept = rate.imag >= 0
    # A real rate has no partner; its two halves are counted as a pair.
    share = np.where(rate.imag[kept] > 0, 1.0, 0.5)
    return _DampedPairs(rate[kept], shape[count:, kept], reached[kept] * share[:, None])


def _cached(actuator_mm: Float64Array, outline: Outline, admittance: float) -> tuple[Elements, RitzModes]:
    """Elements and modes from the disk, or computed and kept there; without a file that can be used, computed again."""
    facts = (RECIPE, SOFT_PLATE, HIGHEST_HZ, outline, admittance)
    digest = hashlib.sha256(repr(facts).encode() + np.ascontiguousarray(actuator_mm, dtype="<f8").tobytes())
    path = cache_dir() / f"stadium-{digest.hexdigest()[:32]}.npz"
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
            return (
                Elements(Triangles(*(kept[item.name] for item in fields(Triangles)))),
                RitzModes(*(kept[item.name] for item in fields(RitzModes))),
            )
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        triangles = triangulate(outline, spacing_mm(SOFT_PLATE, HIGHEST_HZ))
    elements = Elements(triangles)
    modes = ritz_modes(elements, actuator_mm, SOFT_PLATE, admittance, HIGHEST_HZ)
    modes = replace(modes, shapes=modes.shapes.astype(np.float32))
    kept = {item.name: getattr(part, item.name) for part in (triangles, modes) for item in fields(part)}
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".partial", delete=False) as partial:
            np.savez(partial, **kept)
        Path(partial.name).replace(path)
    return elements, modes


def cache_dir() -> Path:
    """Folder of computed plates: WAVEFOCUS_CACHE, or the user's cache folder of this system."""
    if chosen := os.environ.get("WAVEFOCUS_CACHE"):
        return Path(chosen)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData/Local")) / "wavefocus" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library/Caches/wavefocus"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "wavefocus"
