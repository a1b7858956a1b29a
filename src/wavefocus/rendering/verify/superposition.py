"""Responses as sums over actuators, ``sum_i green_i drive_i`` at some frequencies, each in units of what is allowed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration.neighbour_judge import RowsAtFrequencies
from wavefocus.calibration.numerics import evenly_spread, transform_at
from wavefocus.rendering.arrays import Complex128Array, Float32Array, Float64Array, Int64Array
from wavefocus.rendering.verify.results import Sentinel

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource

LOUD = 3.0
"""Power over that of the noise from which a Green's function is more than noise."""
ALLOWED = 0.01
"""Error of a sound bank, relative to the response."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Responses (rows, K) and what they are made of, each row over what is allowed of it: ``sum_i green_i drive_i``.

    rows, float32 (r, A, L): Green's functions; `row_of` (rows,) says which of them belongs to a response.
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
    noise: float = 0.0

    def at(self, frequency_hz: Float64Array | Complex128Array) -> Block:
        """The same with Green's functions at other frequencies (K,), complex ones too: there, vibrations decay faster.

        Waves that are faster by a factor c have the Green's functions of ``frequency_hz / c``; vibrations that decay
        by ``exp(-d t)`` more have those of ``frequency_hz - j d / (2 pi)``.
        """
        # Where vibrations are made to decay less, the noise behind them must not grow.
        rows = self.rows[..., : self._loud_taps] if np.any(np.imag(frequency_hz) > 0.0) else self.rows
        return self.with_green(transforms(rows, frequency_hz, self.rate_hz))

    @property
    def _loud_taps(self) -> int:
        """Taps until the Green's functions end in their noise, as the last tenth of the taps shows it."""
        power = np.einsum("rat,rat->t", self.rows, self.rows, dtype=np.float64)
        length = max(power.size // 50, 1)
        smooth = np.convolve(power, np.full(length, 1.0 / length), mode="same")
        loud = np.flatnonzero(smooth > LOUD * np.mean(power[-max(power.size // 10, 1) :]))
        return int(loud[-1]) + 1 if loud.size else power.size

    def with_green(self, green: Complex128Array) -> Block:
        """The same with other Green's functions (r, A, K)."""
        return replace(self, green=green[self.row_of] * self.weight[:, None, None])

    def with_response(self, response: Complex128Array) -> Block:
        """The same with other responses."""
        return replace(self, response=response)

    def driven(self, factor: Complex128Array | Float64Array) -> Block:
        """The same with drives multiplied by (A,) or (A, K)."""
        return replace(self, drive=self.drive * factor)

    def exchanged(self, one: int, other: int) -> Block:
        """The same with the drives of two actuators exchanged."""
        order = np.arange(self.drive.shape[1])
        order[[one, other]] = other, one
        return replace(self, drive=self.drive[:, order])

    def some(self, most: int, frequencies: int | None = None) -> Block:
        """The same with some of the responses, or all where they share their rows, at some of the frequencies."""
        block = self
        if frequencies is not None:
            at = evenly_spread(len(self.frequency_hz), frequencies)
            block = replace(
                self, frequency_hz=self.frequency_hz[at], green=self.green[..., at], drive=self.drive[..., at],
                response=self.response[..., at],
            )  # fmt: skip
        if len(self.rows) <= most:
            return block
        chosen = evenly_spread(len(self.rows), most)
        drive = block.drive if len(block.drive) == 1 else block.drive[chosen]
        return replace(
            block, rows=block.rows[chosen], row_of=np.arange(len(chosen)), weight=block.weight[chosen],
            green=block.green[chosen], drive=drive, response=block.response[chosen],
        )  # fmt: skip

    @property
    def parts(self) -> Complex128Array:
        """What each actuator contributes, (rows, A, K)."""
        return np.asarray(self.green * self.drive)

    @property
    def difference(self) -> Complex128Array:
        """Response minus prediction, (rows, K)."""
        return np.asarray(self.response - np.einsum("rak,rak->rk", self.green, self.drive))


Blocks = tuple[Block, ...]


def transforms(rows: NDArray[Any], frequency_hz: Float64Array | Complex128Array, rate_hz: float) -> Complex128Array:
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
    """Put together responses (rows, K), drives (rows or 1, A, K) and Green's functions, each row in its own unit.

    rows, row_of, frequency_hz, rate_hz: As of `Block`.
    noise, float64 (rows,): Energy of the noise in each response, at these frequencies; NaN where unknown.
    """
    green = transforms(rows, frequency_hz, rate_hz)[row_of]
    predicted = np.einsum("rak,rak->rk", green, np.broadcast_to(drive, (len(row_of), *drive.shape[1:])))
    level = 0.5 * (energies(predicted) + energies(response))
    allowed = np.nan_to_num(noise) + ALLOWED**2 * level
    weight = 1.0 / np.sqrt(np.where(allowed > 0.0, allowed, np.inf))
    return Block(
        frequency_hz, rate_hz, rows, row_of, weight, green * weight[:, None, None], drive, response * weight[:, None],
        float(np.nan_to_num(noise) @ weight**2),
    )  # fmt: skip


def sentinel_block(sentinel: Sentinel, green: Float32Array, bank: GreenSource) -> Block:
    """One response for each actuator, which alone is driven, with 1 V at all frequencies."""
    actuators, taps = green.shape
    frequency_hz = RowsAtFrequencies(1, actuators, taps, bank.sample_rate_hz, bank.band_hz).frequency_hz
    alone = np.repeat(np.eye(actuators)[:, :, None], len(frequency_hz), axis=2).astype(np.complex128)
    response = transforms(sentinel.green, frequency_hz, bank.sample_rate_hz)
    noise = 2.0 * energies(response) * 10.0 ** (-np.asarray(sentinel.snr_db, np.float64) / 10.0)  # of both measurements
    row_of = np.zeros(actuators, np.int64)
    return block_of(green[None], row_of, frequency_hz, bank.sample_rate_hz, alone, response, noise)


def with_total(parts: Complex128Array) -> Complex128Array:
    """Contributions (rows, A, K) and behind them their sum, (rows, A + 1, K)."""
    return np.concatenate([parts, parts.sum(axis=1, keepdims=True)], axis=1)


def energies(values: NDArray[Any]) -> Float64Array:
    """Sum of squares of each row."""
    return np.asarray(np.square(np.abs(values)).sum(axis=1), np.float64)


def energy(values: NDArray[Any]) -> float:
    """Sum of squares of all values."""
    return float(np.square(np.abs(values)).sum())
