"""The soft stadium: a gel plate with a rim that reflects, actuators of finite size embedded in its periphery."""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any
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
RECIPE = 2
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
        self._elements, self._modes, facts = _elements_and_modes(actuator_mm, outline, rim_admittance)
        self._pairs = None
        if rim_admittance:
            pairs = partial(_damped_pairs, self._modes, self._wave, rim_admittance)
            kept = _kept("damped", (self._wave, *facts), lambda: _arrays(pairs()))
            self._pairs = _DampedPairs(*(kept[item.name] for item in fields(_DampedPairs)))

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


def _elements_and_modes(
    actuator_mm: Float64Array, outline: Outline, admittance: float
) -> tuple[Elements, RitzModes, tuple[object, ...]]:
    """Elements and modes, from the disk or computed, and the facts that they follow from."""
    facts = (SOFT_PLATE, HIGHEST_HZ, outline, admittance, np.asarray(actuator_mm, dtype=np.float64).tolist())

    def compute() -> dict[str, NDArray[Any]]:
        triangles = triangulate(outline, spacing_mm(SOFT_PLATE, HIGHEST_HZ))
        modes = ritz_modes(Elements(triangles), actuator_mm, SOFT_PLATE, admittance, HIGHEST_HZ)
        return _arrays(triangles) | _arrays(replace(modes, shapes=modes.shapes.astype(np.float32)))

    kept = _kept("stadium", facts, compute)
    triangles = Triangles(*(kept[item.name] for item in fields(Triangles)))
    return Elements(triangles), RitzModes(*(kept[item.name] for item in fields(RitzModes))), facts


def _arrays(part: Triangles | RitzModes | _DampedPairs) -> dict[str, NDArray[Any]]:
    return {item.name: getattr(part, item.name) for item in fields(part)}


def _kept(name: str, facts: tuple[object, ...], compute: Callable[[], dict[str, Any]]) -> Mapping[str, Any]:
    """Arrays from the disk, or computed and kept there; without a file that can be used, computed again."""
    digest = hashlib.sha256(repr((RECIPE, *facts)).encode()).hexdigest()
    path = cache_dir() / f"{name}-{digest[:32]}.npz"
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
            return dict(kept)
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        found = compute()
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".partial", delete=False) as written:
            np.savez(written, **found)
        Path(written.name).replace(path)
    return found


def cache_dir() -> Path:
    """Folder of computed plates: WAVEFOCUS_CACHE, or the user's cache folder of this system."""
    if chosen := os.environ.get("WAVEFOCUS_CACHE"):
        return Path(chosen)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData/Local")) / "wavefocus" / "cache"
    if sys.platform == "darwin":
        return Path.home() / "Library/Caches/wavefocus"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "wavefocus"
