"""An affine error of the mirror as a cause: every position x shows the field of ``x + shift + (M - 1) x``."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from wavefocus.calibration.evidence import CERTAIN_SHARE, MOST, TOLERANCE
from wavefocus.calibration.numerics import evenly_spread
from wavefocus.calibration.wave_model import Patch, PatchKernel, WaveModel, every_second, fit_waves
from wavefocus.rendering.arrays import BoolArray, Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.verify.results import Sentinel
from wavefocus.rendering.verify.superposition import Block, energy, sentinel_block, transforms
from wavefocus.storage.bank.ledger import Status

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource

_MAX_OUTSIDE = 0.75
"""Grid spacings from the nearest measured position beyond which a field is not known: places of a full square grid lie
within half a diagonal, 0.71."""
_START_STEPS = (-1.0, -0.5, 0.5, 1.0)
"""Shifts in grid spacings that the search starts from; turned or scaled, the rim moves as far."""
MIN_SPACINGS = TOLERANCE * 8 / (2 * np.pi)
"""Smaller displacements, 1/16, are not named: at eight positions a wavelength they are within the tolerance."""
STEP_MM = 0.05


def displacement_mm(affine: Float64Array, place_mm: Float64Array) -> Float64Array:
    """From places (n, 2) to the places that they show, with `affine` (2, 3) as of `Symptom`."""
    return np.asarray(affine[:, 2] + place_mm @ affine[:, :2].T)


def affine_value(affine: Float64Array) -> tuple[float, float, float]:
    """Shift in mm, rotation in degrees, counter-clockwise, and change of scale, 0.01 for 1 %."""
    (along, across), (turned, up) = np.eye(2) + affine[:, :2]
    rotation_deg = float(np.degrees(np.arctan2(turned - across, along + up)))
    scale = float(np.sqrt(abs(along * up - across * turned)))
    return float(np.hypot(*affine[:, 2])), rotation_deg, scale - 1.0


def _affine(numbers: Float64Array) -> Float64Array:
    """From six numbers, the shift, and the stretch row by row."""
    return np.column_stack([numbers[2:].reshape(2, 2), numbers[:2]])


class BankAsField:
    """A bank's valid positions, their neighbours, and the waves that the bank shows."""

    def __init__(self, bank: GreenSource) -> None:
        from scipy.spatial import cKDTree  # slow to load

        self.bank = bank
        self.place_mm = np.asarray(bank.position_mm, np.float64)
        self._rows = np.flatnonzero(np.asarray(bank.status) == Status.VALID).astype(np.int64)
        there_mm = self.place_mm[self._rows]
        self._tree = cKDTree(there_mm)
        two_ways = len(self._rows) >= 9 and np.linalg.matrix_rank(there_mm - there_mm[0], 1e-3) == 2
        self.spacing_mm = float(np.median(np.asarray(self._tree.query(there_mm, 2)[0])[:, 1])) if two_ways else 0.0

    @property
    def usable(self) -> bool:
        """Whether there are positions enough, and not on one line."""
        return self.spacing_mm > 0.0

    def patch(self, row: int) -> Patch:
        """A row and its nearest neighbours."""
        # Positions that a place is interpolated from: a lattice's, within two and a half steps.
        near = self._rows[np.asarray(self._tree.query(self.place_mm[row], min(21, len(self._rows)))[1])]
        offset_mm = (self.place_mm[near] - self.place_mm[row]).round(6)
        order = np.lexsort((offset_mm[:, 1], offset_mm[:, 0], np.hypot(*offset_mm.T).round(6)))
        return Patch(near[order], offset_mm[order], offset_mm[order].tobytes())

    def is_known(self, place_mm: Float64Array) -> BoolArray:
        """Places (n, 2) that lie near enough to a measured position."""
        return np.asarray(self._tree.query(place_mm)[0] <= _MAX_OUTSIDE * self.spacing_mm)

    @cached_property
    def waves(self) -> WaveModel:
        """Wave numbers over the bank's band, or the lower half of its frequencies."""
        bank = self.bank
        low_hz, high_hz = bank.band_hz or (0.0, bank.sample_rate_hz / 4.0)
        frequency_hz = every_second(np.geomspace(max(low_hz, high_hz / 20.0), high_hz, 9))
        patches = [self.patch(int(self._rows[index])) for index in evenly_spread(len(self._rows), 6)]
        return fit_waves(patches, frequency_hz, lambda rows: self.green(rows, frequency_hz), self.spacing_mm)

    def green(self, rows: Int64Array, frequency_hz: Float64Array) -> Complex128Array:
        """Transforms of the Green's functions of rows, (K, rows, A)."""
        found = [transforms(self.bank.green(int(row)), frequency_hz, self.bank.sample_rate_hz) for row in rows]
        return np.moveaxis(np.stack(found), -1, 0)

    @property
    def dispersion(self) -> float:
        """Exponent of the wave number over the frequency: 1 of a gel's waves, 1/2 of a plate's that bends."""
        waves = self.waves
        slope = np.polyfit(np.log(waves.frequency_hz), np.log(waves.wavenumber_rad_mm.real), 1)[0]
        # Exponent of the wave number over the frequency, midway between a bending plate's, 1/2, and a gel's, 1.
        return 0.5 if slope < 0.75 else 1.0


class _DisplacedField:
    """Fields at displaced places of some rows, by regression from the positions around each.

    green, complex128 (K, used rows, A): Transforms of the rows of all patches.
    """

    def __init__(self, surface: BankAsField, rows: Int64Array, frequency_hz: Float64Array) -> None:
        patches = [surface.patch(int(row)) for row in rows]
        used = np.unique(np.concatenate([patch.rows for patch in patches]))
        self.green = surface.green(used, frequency_hz)
        waves, alike = surface.waves.at(frequency_hz), [patch.key for patch in patches]
        self._groups = []
        for key in dict.fromkeys(alike):
            members = np.array([index for index, other in enumerate(alike) if other == key])
            at = np.stack([np.searchsorted(used, patches[index].rows) for index in members])
            self._groups.append((members, at, PatchKernel(waves, patches[members[0]].offset_mm)))

    def at(self, displacement_mm: Float64Array, values: Complex128Array) -> Complex128Array:
        """Values (K, rows, columns) at displaced places (rows, 2) of the rows, from those of the used rows."""
        found = np.empty((len(values), len(displacement_mm), values.shape[2]), np.complex128)
        for members, at, kernel in self._groups:
            weights = kernel.weights(displacement_mm[members])
            found[:, members] = np.einsum("kpn,kpnc->kpc", weights, values[:, at])
        return found


_Part = tuple[_DisplacedField, Complex128Array, Int64Array]
"""Predicted responses around a block's positions, at some of its frequencies."""


class MirrorFit:
    """The search for the mirror's error that leaves least of the differences of a block.

    rows: Bank rows of the block's own rows.
    change: Share by which waves are faster than in the bank.
    """

    def __init__(self, surface: BankAsField, block: Block, rows: Int64Array, change: float = 0.0) -> None:
        self._surface, self._block, self._rows = surface, block, rows
        self._place_mm = surface.place_mm[rows]
        chosen = evenly_spread(len(block.frequency_hz), 32)
        low = chosen[: (len(chosen) + 1) // 2 : 2]  # long waves lead from afar
        self._parts = [self._part(frequencies, change) for frequencies in (low, chosen)]

    def _part(self, frequencies: Int64Array, change: float) -> _Part:
        frequency_hz = self._block.frequency_hz[frequencies] / (1.0 + change)
        field = _DisplacedField(self._surface, self._rows, frequency_hz)
        values = np.einsum("kua,ak->ku", field.green, self._block.drive[0][:, frequencies])
        return field, values[..., None], frequencies

    def best(self) -> tuple[Float64Array, float]:
        """The error, (2, 3), and the share of the squares that it leaves where the field is known."""
        numbers = min(self._starts(), key=lambda start: self._left(start, self._parts[0]))
        for part in self._parts:
            numbers = self._refined(numbers, part)
        return _affine(numbers), self._left(numbers, self._parts[1])

    def _starts(self) -> Iterator[Float64Array]:
        yield np.zeros(6)
        spacing_mm, steps = self._surface.spacing_mm, (0.0, *_START_STEPS)
        yield from (spacing_mm * np.array([x, y, 0, 0, 0, 0]) for x in steps for y in steps if x or y)
        share = spacing_mm / float(np.hypot(*self._place_mm.T).max(initial=spacing_mm))
        for step in _START_STEPS:
            for shape in ((0, -1, 1, 0), (1, 0, 0, 1), (1, 0, 0, 0), (0, 0, 0, 1)):
                yield step * share * np.array([0, 0, *shape])

    def _left(self, numbers: Float64Array, part: _Part) -> float:
        by_mm = displacement_mm(_affine(numbers), self._place_mm)
        known = self._surface.is_known(self._place_mm + by_mm)
        if np.mean(known) < MOST:
            return np.inf
        own = energy(self._block.difference[known][:, part[2]])
        return energy(self._difference(by_mm, part)[known]) / max(own, 1e-300)

    def _difference(self, by_mm: Float64Array, part: _Part) -> Complex128Array:
        field, values, frequencies = part
        predicted = field.at(by_mm, values)[..., 0].T
        return np.asarray(self._block.response[:, frequencies] - predicted * self._block.weight[:, None])

    def _refined(self, numbers: Float64Array, part: _Part) -> Float64Array:
        """Gauss-Newton steps, halved where they do not help."""
        left = self._left(numbers, part)
        for _ in range(8):
            by_mm = displacement_mm(_affine(numbers), self._place_mm)
            known = self._surface.is_known(self._place_mm + by_mm)
            at = self._difference(by_mm, part)
            shift = [(self._difference(by_mm + STEP_MM * axis, part) - at) / STEP_MM for axis in np.eye(2)]
            stretch = [slope * along_mm[:, None] for slope in shift for along_mm in self._place_mm.T]
            matrix = np.stack([column[known].ravel() for column in (*shift, *stretch)], axis=1)
            wrong = at[known].ravel()
            step = np.linalg.lstsq(
                np.concatenate([matrix.real, matrix.imag]), -np.concatenate([wrong.real, wrong.imag]), rcond=1e-8
            )[0]
            for _half in range(4):
                tried = self._left(numbers + step, part)
                if tried < left:
                    break
                step = 0.5 * step
            else:
                break
            gained, left, numbers = left - tried, tried, numbers + step
            if gained < 1e-3 * left:
                break
        return numbers


def displaced(surface: BankAsField, affine: Float64Array, block: Block, rows: Int64Array, change: float) -> Block:
    """A block with the Green's functions of displaced places, without the responses at which these are not known."""
    field = _DisplacedField(surface, rows, block.frequency_hz / (1.0 + change))
    by_mm = displacement_mm(affine, surface.place_mm[rows])
    green = field.at(by_mm, field.green)
    known = surface.is_known(surface.place_mm[rows] + by_mm)[block.row_of]
    moved = block.with_green(np.moveaxis(green, 0, -1))
    return moved.of(np.flatnonzero(known)) if known.any() else moved


def sentinel_shift_mm(sentinel: Sentinel, bank: GreenSource) -> Float64Array | None:
    """The way (2,) to the place whose Green's functions the sentinel position shows now.

    None where that does not explain how it has changed, or is less than a sixteenth of the spacing.
    """
    from scipy.optimize import minimize  # slow to load

    surface, block = BankAsField(bank), sentinel_block(sentinel, bank)
    excess = energy(block.difference) - block.noise
    if not surface.usable or excess <= len(block.response):
        return None
    field = _DisplacedField(surface, np.array([sentinel.position]), block.frequency_hz)

    def left(by_mm: Float64Array) -> float:
        green = field.at(np.asarray(by_mm)[None], field.green)[:, 0].T
        return energy(block.response - green * block.weight[:, None])

    steps = surface.spacing_mm * np.array([0.0, *_START_STEPS])
    start = min((np.array([x, y]) for x in steps for y in steps), key=left)
    simplex = start + 0.25 * surface.spacing_mm * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    options: Any = {"xatol": 0.01, "fatol": 1e-3 * excess, "initial_simplex": simplex}
    found = minimize(left, start, method="Nelder-Mead", options=options)
    explains = found.fun - block.noise <= (1.0 - CERTAIN_SHARE) * excess
    far = float(np.hypot(*found.x)) >= MIN_SPACINGS * surface.spacing_mm
    return np.asarray(found.x) if explains and far else None
