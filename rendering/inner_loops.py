"""The inner loops of rendering, compiled where a compiler was at hand when wavefocus was installed.

They make one pass where numpy makes several, and run without Python's lock: other threads go on meanwhile. What they
do, numpy does as well, more slowly; who calls them asks `inner_loops` first. The results differ by rounding alone.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]
Complex64Array = NDArray[np.complex64]
Complex128Array = NDArray[np.complex128]

VARIABLE = "WAVEFOCUS_INNER_LOOPS"
"""In the environment it says `numpy` to leave the compiled loops alone, as for a comparison."""
VERSION = 2
"""As `inner_loops.c` has it: a library that was built from another source is not used."""
RADICES = (4, 2, 3, 5)
"""Factors of half a transform's length."""


@cache
def inner_loops() -> InnerLoops | None:
    """The compiled loops; None where there are none, or none are wanted."""
    if os.environ.get(VARIABLE) == "numpy":
        return None
    found = importlib.util.find_spec("rendering._inner_loops")
    if found is None or found.origin is None:
        return None
    try:
        library = ctypes.CDLL(found.origin)
        if library.wavefocus_version() != VERSION:
            return None
    except (OSError, AttributeError):
        return None
    return InnerLoops(library)


class InnerLoops:
    """What `inner_loops.c` has, for numpy's arrays.

    Arrays are contiguous and of the machine's byte order; nothing is checked. Several threads may call.

    Parameters
    ----------
    library : ctypes.CDLL
        The library.
    """

    def __init__(self, library: ctypes.CDLL) -> None:
        at, size, double = ctypes.c_void_p, ctypes.c_ssize_t, ctypes.c_double
        self._look = _function(library, "look", at, size, size, size, size, at, at, at)
        self._transform = _function(library, "transform", at, at, size, at, at, at, at)
        self._blocks = _function(library, "blocks", at, at, at, size, at, at, at, at)
        self._sum = _function(library, "sum", at, at, at, size, size, size, at, at, at, size)
        self._windows = _function(library, "windows", at, at, size, at, at, at, at)
        self._scale = {
            np.dtype(np.float32): _function(library, "widen", at, size, size, size, double, at, size, at),
            np.dtype(np.float64): _function(library, "scale", at, size, size, size, double, at, size, at),
        }

    def look(self, rows: Sequence[Float32Array], used: int) -> tuple[Float32Array, Float32Array, Float64Array]:
        """Look at rows once.

        Parameters
        ----------
        rows : sequence of float32 arrays, shape (actuators, taps)
        used : int
            Taps at the beginning whose energies are told apart from those of the others.

        Returns
        -------
        largest, smallest : float32 array, shape (rows,)
            Largest and smallest magnitude, zeros not counted; infinite or NaN where a value is not finite, and NaN for
            the smallest of nothing but zeros.
        energies : float64 array, shape (rows, 2, actuators)
            Of the taps used, and of the others.
        """
        actuators, taps = rows[0].shape
        found, energies = np.empty((2, len(rows)), dtype=np.uint32), np.empty((len(rows), 2, actuators))
        largest, smallest = found
        where = _addresses(rows)
        self._look(
            where.ctypes.data,
            len(rows),
            actuators,
            taps,
            used,
            largest.ctypes.data,
            smallest.ctypes.data,
            energies.ctypes.data,
        )
        smallest[smallest < np.iinfo(np.uint32).max] += np.uint32(1)
        return largest.view(np.float32), smallest.view(np.float32), energies

    def transform(
        self, transform: RowTransform, rows: Sequence[Float32Array], scales: Float32Array, kept: NDArray[np.uintp]
    ) -> Float32Array:
        """Transform rows.

        Parameters
        ----------
        transform : RowTransform
            What they have in common.
        rows : sequence of float32 arrays, shape (actuators, taps)
        scales : float32 array, shape (rows,)
            What each of them is multiplied with.
        kept : uintp array, shape (rows,)
            Addresses of complex64 arrays (bins kept, actuators used), which get the bins that are kept.

        Returns
        -------
        float32 array, shape (rows, bins)
            Squares of the magnitudes of all bins, added up over the actuators used.
        """
        bins = transform.length // 2 + 1
        room = np.empty(16 * transform.length + 8 * bins, dtype=np.float32)
        squares = np.empty((len(rows), bins), dtype=np.float32)
        where = _addresses(rows)
        shape = ctypes.addressof(transform.shape)
        self._transform(
            where.ctypes.data,
            scales.ctypes.data,
            len(rows),
            shape,
            room.ctypes.data,
            kept.ctypes.data,
            squares.ctypes.data,
        )
        return squares

    def blocks(
        self,
        back: TransformBack,
        rows: NDArray[np.uintp],
        windows: Complex64Array,
        bounds: Int64Array,
        out: Float32Array,
    ) -> Float64Array:
        """Sum rows times windows, block by block, and transform the sums back.

        Parameters
        ----------
        back : TransformBack
            What blocks have in common.
        rows : uintp array, shape (rows,)
            Addresses of complex64 arrays (bins computed, actuators).
        windows : complex64 array, shape (rows, bins computed)
            One for each row.
        bounds : int64 array, shape (blocks + 1,)
            Where each block's rows begin, and the end.
        out : float32 array, shape (blocks, actuators, length)
            Gets the blocks.

        Returns
        -------
        float64 array, shape (blocks,)
            Their energies, summed up in single precision along each signal.
        """
        energies = np.empty(len(out))
        room = np.empty(back.room, dtype=np.float32)
        shape = ctypes.addressof(back.shape)
        self._blocks(
            rows.ctypes.data,
            windows.ctypes.data,
            bounds.ctypes.data,
            len(out),
            shape,
            room.ctypes.data,
            out.ctypes.data,
            energies.ctypes.data,
        )
        return energies

    def sum(
        self,
        rows: NDArray[np.uintp],
        windows: Complex128Array,
        bounds: Int64Array,
        turn: Complex128Array,
        out: Complex128Array,
    ) -> None:
        """Sum rows times windows in double precision, group by group.

        Parameters
        ----------
        rows : uintp array, shape (rows,)
            Addresses of complex128 arrays (bins, actuators).
        windows : complex128 array, shape (rows, bins)
        bounds : int64 array, shape (groups + 1,)
            Where each group's rows begin, and the end.
        turn : complex128 array, shape (bins,)
            What all sums are multiplied with.
        out : complex128 array, shape (groups, bins, actuators)
            Gets the sums; each group is contiguous, and as it was where it has no row.
        """
        groups, bins, actuators = out.shape
        room = np.empty(4 * actuators)
        self._sum(
            rows.ctypes.data,
            windows.ctypes.data,
            bounds.ctypes.data,
            groups,
            bins,
            actuators,
            turn.ctypes.data,
            room.ctypes.data,
            out.ctypes.data,
            out.strides[0] // 8,
        )

    def windows(
        self,
        transform: WindowTransform,
        bounds: Int64Array,
        kept: Complex64Array,
        largest: Float32Array,
        energies: Float64Array,
    ) -> None:
        """Transform windows.

        Parameters
        ----------
        transform : WindowTransform
            What they have in common.
        bounds : int64 array, shape (windows, 2)
            First run of each, and one past the last.
        kept : complex64 array, shape (windows, bins kept)
            Gets the bins that are kept.
        largest : float32 array, shape (windows, segments)
            Gets the largest square of a magnitude in each segment.
        energies : float64 array, shape (windows, 3)
            Gets the squares added up: of the samples, of the magnitudes in the band, and in all bins.
        """
        room = np.empty(transform.room, dtype=np.float32)
        shape = ctypes.addressof(transform.shape)
        self._windows(
            shape,
            bounds.ctypes.data,
            len(bounds),
            room.ctypes.data,
            kept.ctypes.data,
            largest.ctypes.data,
            energies.ctypes.data,
        )

    def scale(self, signals: Float32Array | Float64Array, factor: float, out: Float64Array) -> Float64Array:
        """Multiply signals in double precision.

        Parameters
        ----------
        signals : float32 or float64 array, shape (signals, samples)
            Each is contiguous.
        factor : float
        out : float64 array, shape (signals, samples)
            Gets the products; likewise.

        Returns
        -------
        float64 array, shape (signals,)
            Energies of the products.
        """
        count, samples = signals.shape
        energies = np.empty(count)
        apart, out_apart = signals.strides[0] // signals.itemsize, out.strides[0] // out.itemsize
        self._scale[signals.dtype](
            signals.ctypes.data, apart, count, samples, factor, out.ctypes.data, out_apart, energies.ctypes.data
        )
        return energies


class RowTransform:
    """What transforms of rows have in common.

    Parameters
    ----------
    taps, used : int
        Taps of a row, and how many of them, from the first, are transformed.
    actuators : int64 array
        Which actuators.
    length : int
        Transform length, as `transformable` allows, and at least `used`.
    low, high : int
        Bins low <= bin < high are kept.
    conjugate : bool
        Whether their conjugates are kept instead.
    """

    def __init__(
        self, taps: int, used: int, actuators: Int64Array, length: int, low: int, high: int, *, conjugate: bool
    ) -> None:
        self.length = length
        transform = _transform(length)
        actuators = np.ascontiguousarray(actuators, dtype=np.int64)
        self._held = (transform, actuators)
        self.shape = _Shape(transform, taps, used, actuators.ctypes.data, len(actuators), low, high, conjugate)
        """As the compiled loops have it."""


class TransformBack:
    """What transforms of blocks back to time have in common.

    Parameters
    ----------
    actuators, length : int
        Of a block; a length as `transformable` allows.
    low, high : int
        Bins low <= bin < high are computed, the others are zero.
    turn : complex64 array, shape (high - low,)
        What bins are multiplied with.
    """

    def __init__(self, actuators: int, length: int, low: int, high: int, turn: Complex64Array) -> None:
        transform = _transform(length)
        turn = np.ascontiguousarray(turn, dtype=np.complex64)
        self._held = (transform, turn)
        self.room = 16 * length + 2 * actuators * (high - low + 2)
        """Numbers that the compiled loops need to work in."""
        self.shape = _Back(transform, actuators, low, high, turn.ctypes.data)
        """As they have it."""


@dataclass(frozen=True, slots=True)
class Runs:
    """Runs of samples that windows are made of.

    Parameters
    ----------
    values : float64 array, shape (samples,)
        Samples of all runs, anywhere.
    begin, start, count : int64 array, shape (runs,)
        Where each begins among the values and in its window, and how many samples it has; within a window no two meet.
    factor : float64 array, shape (runs,)
        What its values are multiplied with.
    """

    values: Float64Array
    begin: Int64Array
    start: Int64Array
    count: Int64Array
    factor: Float64Array


class WindowTransform:
    """What transforms of windows have in common.

    Parameters
    ----------
    runs : Runs
        What windows are made of.
    length : int
        Transform length, as `transformable` allows.
    low, high : int
        Bins low <= bin < high are kept.
    starts : int64 array, shape (segments,)
        First bin of each segment, the first one 0.
    band : slice
        Bins whose energy is told apart.
    """

    def __init__(self, runs: Runs, length: int, low: int, high: int, starts: Int64Array, band: slice) -> None:
        transform = _transform(length)
        bins = length // 2 + 1
        segment = np.repeat(np.arange(len(starts), dtype=np.int32), np.diff(starts, append=bins))
        arrays = [
            np.ascontiguousarray(array) for array in (runs.values, runs.begin, runs.start, runs.count, runs.factor)
        ]
        self._held = (transform, segment, arrays)
        self.room = 16 * length + 8 * len(starts)
        """Numbers that the compiled loops need to work in."""
        self.shape = _Windows(
            transform,
            low,
            high,
            segment.ctypes.data,
            len(starts),
            band.start,
            band.stop,
            *(array.ctypes.data for array in arrays),
        )
        """As they have it."""


def transformable(length: int) -> bool:
    """Whether the compiled loops have transforms of this length."""
    return length % 2 == 0 and _factors(length // 2)[1] == 1


class _Transform(ctypes.Structure):
    """`struct transform` of `inner_loops.c`."""

    _fields_ = (
        ("length", ctypes.c_ssize_t),
        ("factors", ctypes.c_void_p),
        ("turns", ctypes.c_void_p),
        ("half_turns", ctypes.c_void_p),
    )
    held: tuple[NDArray[Any], ...]
    """What it points to: as long as it lives, not its copies."""


class _Shape(ctypes.Structure):
    """`struct shape` of `inner_loops.c`."""

    _fields_ = (
        ("transform", _Transform),
        ("taps", ctypes.c_ssize_t),
        ("used", ctypes.c_ssize_t),
        ("actuators", ctypes.c_void_p),
        ("heard", ctypes.c_ssize_t),
        ("low", ctypes.c_ssize_t),
        ("high", ctypes.c_ssize_t),
        ("conjugate", ctypes.c_ssize_t),
    )


class _Back(ctypes.Structure):
    """`struct back` of `inner_loops.c`."""

    _fields_ = (
        ("transform", _Transform),
        ("actuators", ctypes.c_ssize_t),
        ("low", ctypes.c_ssize_t),
        ("high", ctypes.c_ssize_t),
        ("turn", ctypes.c_void_p),
    )


class _Windows(ctypes.Structure):
    """`struct windows` of `inner_loops.c`."""

    _fields_ = (
        ("transform", _Transform),
        ("low", ctypes.c_ssize_t),
        ("high", ctypes.c_ssize_t),
        ("segment", ctypes.c_void_p),
        ("segments", ctypes.c_ssize_t),
        ("band_low", ctypes.c_ssize_t),
        ("band_high", ctypes.c_ssize_t),
        ("values", ctypes.c_void_p),
        ("begin", ctypes.c_void_p),
        ("start", ctypes.c_void_p),
        ("count", ctypes.c_void_p),
        ("factor", ctypes.c_void_p),
    )


def _factors(length: int) -> tuple[list[int], int]:
    """Radices that make a length, and what is left over."""
    found = []
    for radix in RADICES:
        while length > 1 and length % radix == 0:
            found.append(radix)
            length //= radix
    return found, length


@lru_cache(maxsize=8)
def _transform(length: int) -> _Transform:
    """A transform of this length; whoever copies it holds on to it, too."""
    half = length // 2
    cycles = np.arange(half) / half
    factors = np.array([*_factors(half)[0], 1], dtype=np.int64)
    turns, half_turns = (np.exp(-1j * angle * cycles).astype(np.complex64) for angle in (2.0 * np.pi, np.pi))
    found = _Transform(length, *(array.ctypes.data for array in (factors, turns, half_turns)))
    found.held = (factors, turns, half_turns)
    return found


def _addresses(arrays: Sequence[NDArray[Any]]) -> NDArray[np.uintp]:
    return np.array([array.ctypes.data for array in arrays], dtype=np.uintp)


def _function(library: ctypes.CDLL, name: str, *arguments: Any) -> Any:
    function = library[f"wavefocus_{name}"]
    function.restype, function.argtypes = None, arguments
    return function
