"""An error of the mirror as a cause: every position shows the field of a place that is shifted, rotated or scaled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.calibration.wave_model import (
    DISK_RADIUS,
    MAX_GROWTH,
    MIN_DIRECTIONS,
    Patch,
    PatchKernel,
    WaveModel,
    disk_kernel,
    fit_waves,
)
from wavefocus.rendering.arrays import Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.verify.superposition import Block, energy, transforms
from wavefocus.storage.point_status import Status

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource

PATCH = 21
"""Positions that a place is interpolated from: a lattice's, within two and a half steps."""
MIN_POSITIONS = 9
WAVE_PATCHES, WAVE_FREQUENCIES = 6, 9
FIT_FREQUENCIES = 32
MAX_OUTSIDE = 0.75
"""Grid spacings from the nearest measured position beyond which a field is not known."""
MIN_INSIDE = 0.5
"""Share of the positions that must show a known field."""
COARSE_STEPS = (-1.0, -0.5, 0.0, 0.5, 1.0)
COARSE_TURNS_DEG = (-20.0, -10.0, -5.0, 5.0, 10.0, 20.0)
COARSE_SCALES = (-0.2, -0.1, -0.05, 0.05, 0.1, 0.2)
ITERATIONS = 6
STEP_MM = 0.05


@dataclass(frozen=True, slots=True)
class MirrorError:
    """A place x on the surface is shown as ``shift_mm + M x``.

    M is a rotation by `rotation_rad`, times `scale`, after a stretch of y against x (`stretch`, `shear`).
    """

    shift_mm: tuple[float, float] = (0.0, 0.0)
    rotation_rad: float = 0.0
    scale: float = 1.0
    stretch: float = 0.0
    shear: float = 0.0

    @classmethod
    def of(cls, numbers: Float64Array) -> MirrorError:
        """From shift x, shift y, rotation, logarithm of the scale, stretch and shear."""
        x_mm, y_mm, turn, size, stretch, shear = (float(number) for number in numbers)
        return cls((x_mm, y_mm), turn, float(np.exp(size)), stretch, shear)

    def displacement_mm(self, place_mm: Float64Array) -> Float64Array:
        """From places (n, 2) to the places that they show."""
        cos, sin = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        uneven = np.array([[1.0 - self.stretch, self.shear], [self.shear, 1.0 + self.stretch]])
        matrix = self.scale * np.array([[cos, -sin], [sin, cos]]) @ uneven
        return np.asarray(place_mm @ (matrix - np.eye(2)).T + self.shift_mm)


SHIFT, ROTATION, SCALE = (0, 1), (2,), (3,)
ALL = (0, 1, 2, 3, 4, 5)


class InterpolatedBank:
    """A bank as a field between its positions: damped waves, fitted to it, and a kernel regression from neighbours."""

    def __init__(self, bank: GreenSource) -> None:
        from scipy.spatial import cKDTree  # slow to load

        self.bank = bank
        self.rows = np.flatnonzero(np.asarray(bank.status) == Status.VALID).astype(np.int64)
        self.place_mm = np.asarray(bank.position_mm, np.float64)
        self.tree = cKDTree(self.place_mm[self.rows])
        there_mm = self.place_mm[self.rows]
        two_ways = len(self.rows) >= MIN_POSITIONS and np.linalg.matrix_rank(there_mm - there_mm[0], 1e-3) == 2
        self.spacing_mm = float(np.median(np.asarray(self.tree.query(there_mm, 2)[0])[:, 1])) if two_ways else 0.0
        self.usable = self.spacing_mm > 0.0

    def patch(self, row: int) -> Patch:
        """A row and its nearest neighbours."""
        near = self.rows[np.asarray(self.tree.query(self.place_mm[row], min(PATCH, len(self.rows)))[1])]
        offset_mm = (self.place_mm[near] - self.place_mm[row]).round(6)
        order = np.lexsort((offset_mm[:, 1], offset_mm[:, 0], np.hypot(*offset_mm.T).round(6)))
        return Patch(near[order], offset_mm[order], offset_mm[order].tobytes())

    @cached_property
    def waves(self) -> WaveModel:
        """Wave numbers over the bank's band, or the lower half of its frequencies."""
        bank = self.bank
        low_hz, high_hz = bank.band_hz or (0.0, bank.sample_rate_hz / 4.0)
        frequency_hz = np.geomspace(max(low_hz, high_hz / 20.0), high_hz, WAVE_FREQUENCIES)
        patches = [self.patch(int(self.rows[index])) for index in evenly_spread(len(self.rows), WAVE_PATCHES)]
        return fit_waves(patches, frequency_hz, self._values(frequency_hz), self.spacing_mm)

    @property
    def dispersion(self) -> float:
        """Exponent of the wave number over the frequency: 1 of a gel's waves, 1/2 of a plate's that bends."""
        waves = self.waves
        slope = np.polyfit(np.log(waves.frequency_hz), np.log(waves.wavenumber_rad_mm.real), 1)[0]
        return 0.5 if slope < 0.75 else 1.0

    def _values(self, frequency_hz: Float64Array) -> Callable[[Int64Array], Complex128Array]:
        def values(rows: Int64Array) -> Complex128Array:
            green = np.stack([np.asarray(self.bank.green(int(row)), np.float32) for row in rows])
            return np.moveaxis(transforms(green, frequency_hz, self.bank.sample_rate_hz), -1, 0)

        return values

    def outside(self, place_mm: Float64Array) -> Float64Array:
        """Distance of places (n, 2) from the nearest measured position, in grid spacings."""
        return np.asarray(self.tree.query(place_mm)[0] / self.spacing_mm)


class DisplacedBlock:
    """Green's functions and responses of a block at places beside its positions.

    rows: Bank rows of the block's own rows.
    """

    def __init__(self, surface: InterpolatedBank, block: Block, rows: Int64Array) -> None:
        self.block, self._surface = block, surface
        self.place_mm = surface.place_mm[rows]
        self.patches = [surface.patch(int(row)) for row in rows]
        used = np.unique(np.concatenate([patch.rows for patch in self.patches]))
        green = [np.asarray(surface.bank.green(int(row)), np.float32) for row in used]
        self._green = np.stack([transforms(row, block.frequency_hz, block.rate_hz) for row in green])
        self._at = np.stack([np.searchsorted(used, patch.rows) for patch in self.patches])

    def green(self) -> Expansion:
        """Expansion of the Green's functions, (r, A, K)."""
        waves = self._surface.waves.at(self.block.frequency_hz)
        return Expansion(waves, self.patches, np.moveaxis(self._green, 1, -1), self._at)

    def responses(self, frequencies: Int64Array) -> Expansion:
        """Expansion of the responses (r, 1, K) to the block's drives at some of the frequencies."""
        waves = self._surface.waves.at(self.block.frequency_hz[frequencies])
        drive = self.block.drive[0][:, frequencies]
        values = np.einsum("uak,ak->uk", self._green[..., frequencies], drive)
        return Expansion(waves, self.patches, values[..., None], self._at)


class Expansion:
    """Fields around some positions as waves from all directions, and the rest of the kernel's regression.

    waves: At the frequencies (K,).
    patches: Of the positions.
    values, complex128 (used rows, K, columns): Values of the patches' rows; `at` (patches, n) says where.
    """

    def __init__(self, waves: WaveModel, patches: Sequence[Patch], values: Complex128Array, at: Int64Array) -> None:
        inverse: dict[bytes, Complex128Array] = {}
        for patch in patches:
            if patch.key not in inverse:
                inverse[patch.key] = PatchKernel(waves, patch.offset_mm).inverse
        self._offset_mm = np.stack([patch.offset_mm for patch in patches])
        around = np.moveaxis(values[at], 2, 1)
        self._regression = np.stack([
            inverse[patch.key] @ part for patch, part in zip(patches, around, strict=True)
        ])  # fmt: skip
        reach_mm = float(np.hypot(*np.moveaxis(self._offset_mm, -1, 0)).max())
        growth = np.maximum(waves.wavenumber_rad_mm.imag, -MAX_GROWTH / max(reach_mm, 1e-9))
        self._wavenumber, self._share = waves.wavenumber_rad_mm.real + 1j * growth, waves.disk_share
        count = 2 * int(np.ceil(np.abs(self._wavenumber).max() * 1.5 * reach_mm)) + MIN_DIRECTIONS
        angle = 2.0 * np.pi * (np.arange(count) + 0.5) / count
        self._directions = np.stack([np.cos(angle), np.sin(angle)])
        waves_there = self._waves(self._offset_mm)
        self._by_direction = np.einsum("pknd,pknc->pkdc", waves_there.conj(), self._regression, optimize=True)
        self._by_direction *= (1.0 - self._share[:, None, None]) / count

    def _waves(self, offset_mm: Float64Array) -> Complex128Array:
        """Waves (patches, K, n, directions) at offsets (patches, n, 2)."""
        along_mm = offset_mm @ self._directions
        return np.asarray(np.exp(-1j * self._wavenumber[:, None, None] * along_mm[:, None]))

    def at(self, displacement_mm: Float64Array) -> Complex128Array:
        """Values (patches, columns, K) at a displaced place of each patch, float64 (patches, 2)."""
        waves = self._waves(displacement_mm[:, None])[:, :, 0]
        apart_mm = np.hypot(*np.moveaxis(displacement_mm[:, None] - self._offset_mm, -1, 0))
        disk = disk_kernel(DISK_RADIUS * np.abs(self._wavenumber)[:, None] * apart_mm[:, None])
        found = np.einsum("pkd,pkdc->pck", waves, self._by_direction, optimize=True)
        return np.asarray(
            found + np.einsum("pkn,pknc->pck", self._share[:, None] * disk, self._regression, optimize=True)
        )


@dataclass(frozen=True, slots=True)
class _Part:
    """Expected responses at some of the frequencies."""

    responses: Expansion
    frequencies: Int64Array


class MirrorFit:
    """The search for the mirror's error that leaves least of the differences of some blocks."""

    def __init__(self, surface: InterpolatedBank, scan: Block, rows: Int64Array) -> None:
        self._surface, self._displaced, self._scan = surface, DisplacedBlock(surface, scan, rows), scan
        chosen = evenly_spread(len(scan.frequency_hz), FIT_FREQUENCIES)
        low = chosen[scan.frequency_hz[chosen] <= np.median(scan.frequency_hz[chosen])][::2]
        self._fine, self._coarse = self._part(chosen), self._part(low)

    def _part(self, frequencies: Int64Array) -> _Part:
        return _Part(self._displaced.responses(frequencies), frequencies)

    def best(self, free: tuple[int, ...]) -> tuple[MirrorError, float]:
        """The error in which some numbers of `MirrorError.of` are free, and the share of the squares it leaves."""
        starts = [np.zeros(6)]
        if free in (SHIFT, ALL):
            pitch_mm = self._surface.spacing_mm
            starts += [pitch_mm * np.array([x, y, 0, 0, 0, 0]) for x in COARSE_STEPS for y in COARSE_STEPS if x or y]
        if free in (ROTATION, ALL):
            starts += [np.radians(turn) * np.eye(6)[2] for turn in COARSE_TURNS_DEG]
        if free in (SCALE, ALL):
            starts += [np.log1p(size) * np.eye(6)[3] for size in COARSE_SCALES]
        numbers = min(starts, key=lambda start: self._left(self._coarse, start))
        for part in (self._coarse, self._fine):
            numbers = self._refined(part, numbers, free)
        return MirrorError.of(numbers), self._left(self._fine, numbers)

    def left(self, error: MirrorError) -> float:
        """Share of the squares that such an error leaves at the places where the field is known."""
        return self._left_of(self._fine, error)

    def applied(self, error: MirrorError, block: Block, rows: Int64Array) -> Block:
        """A block with the Green's functions of displaced places; those beyond the measured ones stay."""
        displaced = self._displaced if block is self._scan else DisplacedBlock(self._surface, block, rows)
        by_mm = error.displacement_mm(displaced.place_mm)
        return block.with_green(displaced.green().at(by_mm))

    def _left(self, part: _Part, numbers: Float64Array) -> float:
        return self._left_of(part, MirrorError.of(numbers))

    def _left_of(self, part: _Part, error: MirrorError) -> float:
        place_mm = self._displaced.place_mm
        by_mm = error.displacement_mm(place_mm)
        inside = self._inside(place_mm + by_mm)
        if np.mean(inside) < MIN_INSIDE:
            return np.inf
        own = self._scan.difference[:, part.frequencies][inside]
        left = self._difference(part, by_mm)[inside]
        return energy(left) / max(energy(own), 1e-300)

    def _inside(self, place_mm: Float64Array) -> Float64Array:
        return np.asarray(self._surface.outside(place_mm) <= MAX_OUTSIDE)

    def _difference(self, part: _Part, by_mm: Float64Array) -> Complex128Array:
        predicted = part.responses.at(by_mm)[:, 0]
        return np.asarray(self._scan.response[:, part.frequencies] - predicted * self._scan.weight[:, None])

    def _refined(self, part: _Part, numbers: Float64Array, free: tuple[int, ...]) -> Float64Array:
        """Gauss-Newton steps, halved where they do not help."""
        place_mm = self._displaced.place_mm
        reach_mm = float(np.hypot(*place_mm.T).max()) + self._surface.spacing_mm
        unit = np.array([1.0, 1.0, *(4 * [1.0 / reach_mm])])
        left = self._left(part, numbers)
        for _ in range(ITERATIONS):
            by_mm = MirrorError.of(numbers).displacement_mm(place_mm)
            at = self._difference(part, by_mm)
            slope = np.stack([
                (self._difference(part, by_mm + STEP_MM * axis) - at) / STEP_MM for axis in np.eye(2)
            ])  # fmt: skip
            inside = self._inside(place_mm + by_mm)
            columns = []
            for number in free:
                moved = MirrorError.of(numbers + STEP_MM * unit * np.eye(6)[number]).displacement_mm(place_mm)
                columns.append(np.einsum("rd,drk->rk", (moved - by_mm) / STEP_MM, slope)[inside].ravel())
            matrix = np.stack(columns, axis=1)
            step = np.zeros(6)
            step[list(free)] = np.linalg.lstsq(
                np.concatenate([matrix.real, matrix.imag]),
                -np.concatenate([at[inside].real.ravel(), at[inside].imag.ravel()]),
                rcond=1e-6,
            )[0]
            for _half in range(4):
                tried = self._left(part, numbers + step * unit)
                if tried < left:
                    break
                step = 0.5 * step
            else:
                break
            gained, left, numbers = left - tried, tried, numbers + step * unit
            if gained < 1e-3 * left:
                break
        return numbers
