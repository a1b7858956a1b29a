"""Waves as a bank shows them, found by leaving positions out, and the kernel that follows.

A field without sources nearby is a sum of damped plane waves exp(-j k d.x) from all directions d, with the
medium's complex wave number k. What such sums have in common is the covariance

    (1 - s) mean_d exp(-j k d.x) conj(exp(-j k d.y))  +  s 2 J1(a |k| r) / (a |k| r),    r = |x - y|.

The first term holds the waves; the second is the kernel of the disk of wave numbers up to a |k| (a = 1.15),
which holds whatever else the medium does within it. The share s, the wave number and the ridge (noise over
signal, as power) come from the bank, by leaving positions out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np

from wavefocus.calibration import BoolArray, Complex128Array, Float64Array, Int64Array

_DISK_RADIUS = 1.15
"""Radius a of the disk, in wave numbers: room for what the damping smears."""
_MIN_DIRECTIONS = 16
_MAX_GROWTH = 8.0
"""Nepers over a patch beyond which damping cannot be measured: waves from one edge do not reach the other."""


@dataclass(frozen=True, slots=True)
class WaveModel:
    """Waves at some frequencies.

    frequency_hz, float64 (frequencies,): Ascending.
    wavenumber_rad_mm, complex128 (frequencies,): Re k > 0, Im k <= 0, in radians per millimetre.
    disk_share, float64 (frequencies,): Share s of the disk's kernel, above 0 and at most 1.
    ridge, float64 (frequencies,): Added to the covariance of a position with itself, > 0.
    doubtful_hz: Frequencies at which the bank says little of the waves; their wave numbers follow from the others.
    """

    frequency_hz: Float64Array
    wavenumber_rad_mm: Complex128Array
    disk_share: Float64Array
    ridge: Float64Array
    doubtful_hz: tuple[float, ...] = ()

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

    inverse, complex128 (frequencies, n, n): Of the covariance among the positions, ridge included.
    """

    def __init__(self, model: WaveModel, offset_mm: Float64Array) -> None:
        self._offset_mm = offset_mm
        self._share = model.disk_share[:, None, None]
        self._wavenumber, self._directions = _resolved(model.wavenumber_rad_mm, offset_mm)
        waves = self._plane_waves(offset_mm)
        self._conjugate = waves.conj()
        covariance = self._covariance(waves, offset_mm)
        diagonal = np.arange(len(offset_mm))
        covariance[:, diagonal, diagonal] += model.ridge[:, None]
        self.inverse: Complex128Array = np.asarray(np.linalg.inv(covariance), dtype=np.complex128)

    def weights(self, points_mm: Float64Array) -> Complex128Array:
        """Weights w of the positions, the value at a point being sum_n w_n g_n.

        points_mm, float64 (points, 2): Places relative to the patch's first position.

        Returns complex128 (frequencies, points, n).
        """
        across = self._covariance(self._plane_waves(points_mm), points_mm)
        return np.asarray(across @ self.inverse)

    def variance(self, points_mm: Float64Array) -> Float64Array:
        """Expected square of the error at points, for fields of the kernel's own strength, (frequencies, points)."""
        waves = self._plane_waves(points_mm)
        across = self._covariance(waves, points_mm)
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

    def _covariance(self, waves: Complex128Array, points_mm: Float64Array) -> Complex128Array:
        """Of points with the positions."""
        apart_mm = _apart_mm(points_mm, self._offset_mm)
        disk = disk_kernel(_DISK_RADIUS * np.abs(self._wavenumber)[:, None, None] * apart_mm)
        return np.asarray((1.0 - self._share) * _ring(waves, self._conjugate) + self._share * disk)


def disk_kernel(radians: Float64Array) -> Float64Array:
    """2 J1(z) / z, the covariance of fields whose wave numbers fill a disk; 1 at 0."""
    from scipy.special import j1  # slow to load, and only needed where waves are fitted

    safe = np.maximum(np.abs(radians), 1e-8)
    return np.asarray(2.0 * j1(safe) / safe)


def _resolved(wavenumber_rad_mm: Complex128Array, offset_mm: Float64Array) -> tuple[Complex128Array, Float64Array]:
    """Wave numbers, damped no more than a patch can resolve, and enough directions (2, n) for it."""
    reach_mm = max(float(np.hypot(offset_mm[..., 0], offset_mm[..., 1]).max()), 1e-300)
    wavenumber = wavenumber_rad_mm.real + 1j * np.maximum(wavenumber_rad_mm.imag, -_MAX_GROWTH / reach_mm)
    # The trapezoidal rule over directions is exact once it resolves exp(j k d.x) across the patch.
    return wavenumber, _directions(2 * int(np.ceil(np.abs(wavenumber).max() * reach_mm)) + _MIN_DIRECTIONS)


@lru_cache(64)
def _directions(count: int) -> Float64Array:
    angle = 2.0 * np.pi * (np.arange(count) + 0.5) / count
    return np.stack([np.cos(angle), np.sin(angle)])


def _plane_waves(
    wavenumber_rad_mm: Complex128Array, directions: Float64Array, points_mm: Float64Array
) -> Complex128Array:
    return np.asarray(np.exp(-1j * wavenumber_rad_mm[:, None, None] * (points_mm @ directions)))


def _ring(waves: Complex128Array, conjugate: Complex128Array) -> Complex128Array:
    return np.asarray(waves @ conjugate.transpose(0, 2, 1) / waves.shape[2])


def _apart_mm(points_mm: Float64Array, others_mm: Float64Array) -> Float64Array:
    """Distances from each point to each other, (..., n, m)."""
    gap_mm = points_mm[..., :, None, :] - others_mm[..., None, :, :]
    return np.asarray(np.hypot(gap_mm[..., 0], gap_mm[..., 1]))


_SCANNED_RADIANS = np.geomspace(0.1, 3.6, 24)
"""Wave numbers tried, times the grid spacing: from 60 positions per wavelength to fewer than two."""
SCAN_DAMPING, SCAN_SHARE, SCAN_RIDGE = 0.1, 0.1, 1e-4
FIT_SHARE, FIT_RIDGE = 0.01, 1e-4
"""Little of the disk, so that only the right wave number explains what is there; a ridge, so that it must."""
_SHARES = (1e-3, 1e-2, 0.1, 1.0)
_RIDGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)
_EVALUATIONS = 45
_LEFT_OUT = 5
"""Positions of each patch that are left out: the first and its nearest, which still have others all round."""
_MARGIN = 1.02
"""A larger share of the disk is taken where it leaves at most this much more unexplained: it claims less."""


@dataclass(frozen=True, slots=True)
class Patch:
    """A position and its neighbours.

    rows, int64 (n,): Bank rows, that of the position itself first, then by distance and direction.
    offset_mm, float64 (n, 2): Places relative to the position; the first is (0, 0).
    key: Equal for patches of equal shape, for which everything but the rows is the same.
    """

    rows: Int64Array
    offset_mm: Float64Array
    key: bytes


Values = Callable[[Int64Array], Complex128Array]
Items = TypeVar("Items", Float64Array, Int64Array)


def every_second(items: Items) -> Items:
    """The last, every second one before it, and the first: of a band's frequencies, enough to fit waves at."""
    return items[sorted({0, *range(len(items) - 1, -1, -2)})]


def fit_waves(patches: Sequence[Patch], frequency_hz: Float64Array, values: Values, spacing_mm: float) -> WaveModel:
    """Find wave number, disk share and ridge at each frequency.

    Each patch's first positions are left out, one at a time, and predicted from its others; what is least is
    the error of all patches and actuators, each patch relative to its own strength. The wave number is scanned
    for and then refined together with its damping; share and ridge are chosen from a few. They are not refined
    together: with much of the disk any wave number will do, and between two such frequencies none would be right.

    patches: Spread over the surface or along a path, at least one.
    frequency_hz, float64 (frequencies,): Ascending.
    values: Gives the values of bank rows at these frequencies, complex128 (frequencies, rows, actuators).
    spacing_mm: Grid spacing.
    """
    shapes = _gather(patches, values)
    errors_of = _LeftOutErrors([offset_mm for offset_mm, _ in shapes])
    fits = [_Fit(errors_of, [parts[number] for _, parts in shapes]) for number in range(len(frequency_hz))]
    free = np.array([fit.wavenumber(spacing_mm) for fit in fits])
    weight = np.array([fit.weight(k) for fit, k in zip(fits, free, strict=True)])
    wavenumber, doubtful = _joined_by_law(frequency_hz, free, weight)
    choices = [fit.chosen(k) for fit, k in zip(fits, wavenumber, strict=True)]
    for number in np.flatnonzero(doubtful).tolist():
        # What noise leaves looks like a full disk: the share is that of the nearest frequency that is known.
        near = min(np.flatnonzero(~doubtful).tolist(), key=lambda kept: abs(kept - number))
        choices[number] = fits[number].chosen(wavenumber[number], (choices[near][0],))
    share, ridge = np.array(choices).T
    return WaveModel(frequency_hz, wavenumber, share, ridge, tuple(frequency_hz[doubtful].tolist()))


KNOWN = 0.1
"""Weight, over the median of all, below which a frequency may be wrong: its wave number is three times less certain."""
DISAGREES = 0.05
"""A wave number of little weight so far from the law of the others, relatively, is left out: from one
to the next, two thirds of an octave away, dispersion of membranes, gels and plates keeps to a power of the frequency
within 1 %."""
STEP = 1.03
"""Factor on the wave number by which the weight is found."""


def _joined_by_law(
    frequency_hz: Float64Array, wavenumber: Complex128Array, weight: Float64Array
) -> tuple[Complex128Array, BoolArray]:
    """Wave numbers at all frequencies, those that the bank hardly knows from the others; and which these are.

    The law is a power of the frequency, of the real and of the imaginary part each, by weighted least squares in the
    logarithm. Where it replaces a wave number, it goes on from the nearest one that is kept.

    weight, float64 (frequencies,): Inverse variance of the logarithm of each, up to a factor.
    """
    doubtful = np.zeros(len(weight), dtype=bool)
    for number in np.argsort(weight).tolist():
        others = np.flatnonzero(~doubtful & (np.arange(len(weight)) != number))
        if len(others) < 2 or weight[number] >= KNOWN * np.median(weight):
            break
        law = _law(frequency_hz, wavenumber, weight, others)
        doubtful[number] = abs(np.log(wavenumber[number].real / law[number].real)) > DISAGREES
    kept = np.flatnonzero(~doubtful)
    law, found = _law(frequency_hz, wavenumber, weight, kept), wavenumber.copy()
    for number in np.flatnonzero(doubtful).tolist():
        near = kept[np.argmin(np.abs(np.log(frequency_hz[kept] / frequency_hz[number])))]
        real = wavenumber[near].real * law[number].real / law[near].real
        found[number] = complex(real, wavenumber[near].imag * law[number].imag / law[near].imag)
    return found, doubtful


def _law(
    frequency_hz: Float64Array, wavenumber: Complex128Array, weight: Float64Array, kept: Int64Array
) -> Complex128Array:
    """Powers of the frequency through some wave numbers, one where there is only one."""
    if len(kept) < 2:
        return wavenumber
    octave, root = np.log2(frequency_hz), np.sqrt(np.maximum(weight[kept], 1e-9))
    parts = []
    for part in (wavenumber.real, np.minimum(wavenumber.imag, -1e-9 * wavenumber.real)):
        slope, offset = np.polyfit(octave[kept], np.log(np.abs(part[kept])), 1, w=root)
        parts.append(np.exp(slope * octave + offset))
    return np.asarray(parts[0] - 1j * parts[1])


class _LeftOutErrors:
    """What turns the values of patches into the errors at the positions left out; the same at all frequencies.

    offsets_mm, of each shape float64 (n, 2): Positions of its patches.
    """

    def __init__(self, offsets_mm: Sequence[Float64Array]) -> None:
        # Shapes of equally many positions go through linear algebra together.
        sizes = [len(offset_mm) for offset_mm in offsets_mm]
        self.order = sorted(range(len(sizes)), key=sizes.__getitem__)
        """Of shapes, in which their errors come."""
        stacks = [
            np.stack([offsets_mm[shape] for shape in self.order if sizes[shape] == count])
            for count in sorted(set(sizes))
        ]
        # On a grid few distances differ.
        self._stacks = [(stack, *np.unique(_apart_mm(stack, stack), return_inverse=True)) for stack in stacks]
        self._latest: tuple[complex, list[tuple[Complex128Array, Float64Array]]] | None = None
        self.scanned = lru_cache(len(_SCANNED_RADIANS))(self.at)
        """`at`, kept for the wave numbers that are tried at every frequency."""

    def at(self, wavenumber: complex, share: float, ridge: float) -> list[Complex128Array]:
        """The error at position i is row i times the values of a patch, (_LEFT_OUT, n), for each shape."""
        if self._latest is None or self._latest[0] != wavenumber:
            self._latest = wavenumber, [self._parts(wavenumber, *stack) for stack in self._stacks]
        found = []
        for ring, disk in self._latest[1]:
            count = ring.shape[1]
            covariance = (1.0 - share) * ring + share * disk + ridge * np.eye(count)
            # Columns of the inverse, which is Hermitian: (C^-1 g)_i / (C^-1)_ii is the error at position i.
            for column in np.linalg.solve(covariance, np.eye(count, min(_LEFT_OUT, count))):
                found.append(column.conj().T / np.diagonal(column).real[:, None])
        return found

    def _parts(
        self, wavenumber: complex, offset_mm: Float64Array, apart_mm: Float64Array, inverse: Int64Array
    ) -> tuple[Complex128Array, Float64Array]:
        """The two terms of the covariance among the positions of patches, (shapes, n, n) each.

        offset_mm, float64 (shapes, n, 2): Positions of patches of equally many.
        apart_mm, inverse: Their different distances, and which of them each is.
        """
        resolved, directions = _resolved(np.array([wavenumber]), offset_mm)
        waves = _plane_waves(resolved, directions, offset_mm)
        disk = disk_kernel(_DISK_RADIUS * np.abs(resolved) * apart_mm)[inverse]
        return _ring(waves, waves.conj()), disk.reshape(*waves.shape[:2], -1)


class _Fit:
    """The search at one frequency.

    values, of each shape complex128 (n, patches * actuators): Those of its patches, side by side.
    """

    def __init__(self, errors_of: _LeftOutErrors, values: Sequence[Complex128Array]) -> None:
        self._errors_of, self._values = errors_of, [values[shape] for shape in errors_of.order]
        self._whole = sum(float(np.square(np.abs(value[:_LEFT_OUT])).sum()) for value in values)

    def wavenumber(self, spacing_mm: float) -> complex:
        """The wave number that leaves least, found by itself."""
        scanned = _SCANNED_RADIANS / spacing_mm
        tried = [self._errors_of.scanned(complex(k, -SCAN_DAMPING * k), SCAN_SHARE, SCAN_RIDGE) for k in scanned]
        misfits = [self._wrong(errors) for errors in tried]
        start = float(scanned[int(np.argmin(misfits))])
        return self._refined(complex(start, -SCAN_DAMPING * start))

    def weight(self, wavenumber: complex) -> float:
        """Rise of the logarithm of the error about a wave number: the inverse variance of its own logarithm."""
        below, at, above = (
            np.log(max(self._misfit(wavenumber * factor, FIT_SHARE, FIT_RIDGE), 1e-300))
            for factor in (1.0 / STEP, 1.0, STEP)
        )
        return max(float(0.5 * (below + above) - at), 0.0)

    def _refined(self, wavenumber: complex) -> complex:
        from scipy.optimize import minimize  # most campaigns need it at their end only, small ones never

        # In units of the first guess, so that the simplex has the right size both ways.
        unit = wavenumber.real

        def misfit(x: Float64Array) -> float:
            if not 0.3 < x[0] < 3.0:
                return 10.0
            damped = complex(unit * x[0], -unit * abs(x[1]))
            return float(np.log(max(self._misfit(damped, FIT_SHARE, FIT_RIDGE), 1e-300)))

        first = np.array([1.0, -wavenumber.imag / unit])
        simplex = first + np.array([[0.0, 0.0], [0.03, 0.0], [0.0, 0.03]])
        options: Any = {"maxfev": _EVALUATIONS, "xatol": 1e-4, "fatol": 1e-3, "initial_simplex": simplex}
        best = minimize(misfit, first, method="Nelder-Mead", options=options).x
        return complex(unit * best[0], -unit * abs(best[1]))

    def chosen(self, wavenumber: complex, shares: tuple[float, ...] = _SHARES) -> tuple[float, float]:
        """Share of the disk and ridge."""
        choices = [(share, ridge) for share in shares for ridge in _RIDGES]
        misfits = [self._misfit(wavenumber, *choice) for choice in choices]
        enough = _MARGIN**2 * min(misfits)
        return max(choice for choice, misfit in zip(choices, misfits, strict=True) if misfit <= enough)

    def _misfit(self, wavenumber: complex, share: float, ridge: float) -> float:
        return self._wrong(self._errors_of.at(wavenumber, share, ridge))

    def _wrong(self, errors: Sequence[Complex128Array]) -> float:
        """Energy of the errors at the positions left out, over that of what is there."""
        wrong = 0.0
        for error, value in zip(errors, self._values, strict=True):
            wrong += float(np.square(np.abs(error @ value)).sum())
        return wrong / self._whole if self._whole > 0 else 1.0


def _gather(patches: Sequence[Patch], values: Values) -> list[tuple[Float64Array, Complex128Array]]:
    """Patches by shape: positions (n, 2), values (frequencies, n, patches * actuators)."""
    by_shape: dict[bytes, list[Patch]] = {}
    for patch in patches:
        by_shape.setdefault(patch.key, []).append(patch)
    shapes = []
    for alike in by_shape.values():
        parts = []
        for patch in alike:
            part = values(patch.rows)
            strength = np.sqrt(np.mean(np.square(np.abs(part)), axis=(1, 2), keepdims=True))
            parts.append(part / np.where(strength > 0, strength, 1.0))
        shapes.append((alike[0].offset_mm, np.concatenate(parts, axis=2)))
    return shapes
