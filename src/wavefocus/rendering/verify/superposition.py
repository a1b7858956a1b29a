"""Responses as sums over actuators, ``sum_i green_i drive_i`` at some frequencies, each in units of what is allowed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration.evidence import SOUND
from wavefocus.calibration.numerics import evenly_spread, transform_at
from wavefocus.rendering.arrays import Complex128Array, Float32Array, Float64Array, Int64Array
from wavefocus.rendering.verify.results import Sentinel

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Responses (R, K) and what they are made of, each in units of what is allowed of it: ``sum_i green_i drive_i``.

    rows, float32 (r, A, L): Green's functions; `row_of` (R,) says which of them belongs to a response.
    weight, float64 (R,): One over what is allowed of each response.
    green, complex128 (R, A, K): Transforms of the rows, weighted.
    drive, complex128 (R or 1, A, K): Drives.
    noise: Sum of squares that the noise makes, in units of what is allowed.
    """

    frequency_hz: Float64Array
    rate_hz: float
    rows: Float32Array
    row_of: Int64Array
    weight: Float64Array
    green: Complex128Array
    drive: Complex128Array
    response: Complex128Array
    noise: float

    def faster(self, change: float) -> Block:
        """The same where waves are faster by this share: the Green's functions of ``frequency / (1 + change)``."""
        return self.with_green(transforms(self.rows, self.frequency_hz / (1.0 + change), self.rate_hz))

    def with_green(self, green: Complex128Array) -> Block:
        """The same with other Green's functions (r, A, K)."""
        return replace(self, green=green[self.row_of] * self.weight[:, None, None])

    def driven(self, factor: Float64Array, late_s: Float64Array) -> Block:
        """The same with drives changed by a factor (A,), and later by a time (A,)."""
        return replace(
            self, drive=self.drive * (factor[:, None] * np.exp(-2j * np.pi * np.outer(late_s, self.frequency_hz)))
        )

    def exchanged(self, one: int, other: int) -> Block:
        """The same with the drives of two actuators exchanged."""
        order = np.arange(self.drive.shape[1])
        order[[one, other]] = other, one
        return replace(self, drive=self.drive[:, order])

    def some(self, most: int, frequencies: int) -> Block:
        """The same with some of the responses, or all where they share their rows, at some of the frequencies."""
        at = evenly_spread(len(self.frequency_hz), frequencies)
        chosen = np.arange(len(self.response))
        rows, row_of, drive = self.rows, self.row_of, self.drive
        if len(rows) > most:
            chosen = evenly_spread(len(rows), most)
            rows, row_of = rows[chosen], np.arange(len(chosen))
            drive = drive if len(drive) == 1 else drive[chosen]
        return Block(
            self.frequency_hz[at], self.rate_hz, rows, row_of, self.weight[chosen], self.green[chosen][..., at],
            drive[..., at], self.response[chosen][:, at], self.noise,
        )  # fmt: skip

    def of(self, chosen: Int64Array) -> Block:
        """The same with some of the responses."""
        drive = self.drive if len(self.drive) == 1 else self.drive[chosen]
        return replace(
            self, row_of=self.row_of[chosen], weight=self.weight[chosen], green=self.green[chosen], drive=drive,
            response=self.response[chosen],
        )  # fmt: skip

    @property
    def parts(self) -> Complex128Array:
        """What each actuator contributes, (R, A, K)."""
        return np.asarray(self.green * self.drive)

    @property
    def difference(self) -> Complex128Array:
        """Response minus prediction, (R, K)."""
        return np.asarray(self.response - np.einsum("rak,rak->rk", self.green, self.drive))


Blocks = tuple[Block, ...]


def squares_left(blocks: Blocks) -> float:
    """Sum of squares of the differences, in units of what is allowed."""
    return sum(energy(block.difference) for block in blocks)


def transforms(rows: NDArray[Any], frequency_hz: Float64Array, rate_hz: float) -> Complex128Array:
    """Fourier transforms (..., K) of rows (..., taps) as of `transform_at`, made in single precision."""
    return transform_at(np.asarray(rows, np.float32), frequency_hz, rate_hz).astype(np.complex128)


def block_of(
    rows: Float32Array,
    row_of: Int64Array,
    frequency_hz: Float64Array,
    rate_hz: float,
    drive: Complex128Array,
    response: Complex128Array,
    noise: Float64Array,
) -> Block:
    """Put together responses (R, K), drives (R or 1, A, K) and Green's functions, each response in its own unit.

    rows, row_of, frequency_hz, rate_hz: As of `Block`.
    noise, float64 (R,): Energy of the noise in each response, at these frequencies; NaN where unknown.
    """
    green = transforms(rows, frequency_hz, rate_hz)[row_of]
    predicted = np.einsum("rak,rak->rk", green, np.broadcast_to(drive, (len(row_of), *drive.shape[1:])))
    level = 0.5 * (energies(predicted) + energies(response))
    allowed = np.nan_to_num(noise) + SOUND**2 * level
    weight = 1.0 / np.sqrt(np.where(allowed > 0.0, allowed, np.inf))
    return Block(
        frequency_hz, rate_hz, rows, row_of, weight, green * weight[:, None, None], drive, response * weight[:, None],
        float(np.nan_to_num(noise) @ weight**2),
    )  # fmt: skip


def sentinel_block(sentinel: Sentinel, bank: GreenSource) -> Block:
    """One response for each actuator, which alone is driven, with 1 V at all frequencies."""
    rate_hz, rows = bank.sample_rate_hz, np.asarray(bank.green(sentinel.position), np.float32)[None]
    low_hz, high_hz = bank.band_hz or (0.0, 0.45 * rate_hz)
    frequency_hz = np.linspace(max(low_hz, rate_hz / bank.taps), min(high_hz, 0.48 * rate_hz), 64)
    alone = np.repeat(np.eye(bank.actuators)[:, :, None], len(frequency_hz), axis=2).astype(np.complex128)
    response = transforms(sentinel.green, frequency_hz, rate_hz)
    noise = 2.0 * energies(response) * 10.0 ** (-np.asarray(sentinel.snr_db, np.float64) / 10.0)  # of both measurements
    return block_of(rows, np.zeros(bank.actuators, np.int64), frequency_hz, rate_hz, alone, response, noise)


def energies(values: NDArray[Any]) -> Float64Array:
    """Sum of squares of each row."""
    return np.asarray(np.square(np.abs(values)).sum(axis=1), np.float64)


def energy(values: NDArray[Any]) -> float:
    """Sum of squares of all values."""
    return float(np.square(np.abs(values)).sum())
