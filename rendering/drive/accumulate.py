"""The block frequency accumulator: drives from windows of the source and time-reversed bank rows.

The drive of eqs. (9) and (16) is a sum over bank rows of linear convolutions of what the row emits with its
time-reversed Green's functions. Time is cut into blocks; within a block, everything that one row emits is one
window, however many path points it comes from; its spectrum is multiplied with the row's, and a single
inverse transform per block and actuator gives the drives (overlap-add). Cost follows the number of (block,
row) pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rendering.drive.blocks import Blocks
from rendering.drive.omission import ErrorBudget
from rendering.drive.overlap_add import scale, scale_and_measure
from rendering.greens.bank_rows import BankRows
from rendering.scene.emission import Emission
from rendering.threads import one_blas_thread, workers

Float64Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Accumulated:
    """What one emission cost and left out.

    Parameters
    ----------
    error : float
        Bound on the norm of the error from everything left out, rounding included; 0 where nothing was.
    bins : int
        Bins of a block's spectrum.
    kept_bins : int
        How many of them were computed.
    pairs : int
        (Block, row) pairs that were multiplied.
    band_energy : float
    energy : float
        Energy of all windows within the band asked about, and in all.
    left_out_taps : int
        Late taps of every Green's function that were not used.
    left_out_actuators : tuple of int
        Actuators whose drives would hardly count.
    left_out_windows : int
        (Block, row) pairs that hardly emit anything.
    energies : float64 array, shape (actuators,), or None
        Energies of the drives, where there is nothing else in them and they were found on the way.
    """

    error: float
    bins: int
    kept_bins: int
    pairs: int
    band_energy: float
    energy: float
    left_out_taps: int = 0
    left_out_actuators: tuple[int, ...] = ()
    left_out_windows: int = 0
    energies: Float64Array | None = None


class SourceDrives:
    """The drives of one emission, as they come.

    Parameters
    ----------
    emission : Emission
        The source in time.
    rows : BankRows
        Bank rows with their regularisation.
    transform : callable
        Gives the transform length for a number of taps, at least those and event samples - 1.
    tolerance : float
        Relative magnitude that may be left out; a goal, the proved error is told. 0: everything is computed, in
        double precision.
    band_hz : tuple of float, optional
        Band within which the windows' energy is counted.
    on_block : callable, optional
        Told blocks done and blocks in all.
    live : bool
        Make no more at a time than one block, and look ahead no further.
    expected_rows : int
        About how many bank rows the emission comes from, for as much room to be made.
    meanwhile : callable, optional
        Called early, when others compute and there would be nothing to do but to wait for them.
    """

    block_samples: int
    """Samples of drive that one block makes: those within which an event reaches, and a hop to the next block."""

    def __init__(
        self,
        emission: Emission,
        rows: BankRows,
        *,
        transform: Callable[[int], int],
        tolerance: float = 0.0,
        band_hz: tuple[float, float] | None = None,
        on_block: Callable[[int, int], None] | None = None,
        live: bool = False,
        expected_rows: int = 0,
        meanwhile: Callable[[], object] | None = None,
    ) -> None:
        self._expected_rows = expected_rows
        self._meanwhile = meanwhile
        self._live = live
        self.block_samples = transform(rows.bank.taps)
        self._transform = transform
        self._emission = emission
        self._rows = rows
        self._tolerance = tolerance
        self._band_hz = band_hz
        self._on_block = on_block
        self._facts: Accumulated | None = None

    def pieces(self) -> Generator[tuple[int, NDArray[Any], int], None, None]:
        """Give drives that nothing more is added to, without gaps and in order.

        Returns
        -------
        iterator of tuples
            First sample, drives (actuators, samples), and the power of two that they are to be multiplied with.
        """
        with one_blas_thread(), workers() as threads:
            blocks = Blocks(
                self._emission,
                self._rows,
                self._transform,
                self._tolerance,
                self._band_hz,
                threads,
                live=self._live,
                expected_rows=self._expected_rows,
            )
            shape, economy = blocks.shape, blocks.shape.economy
            overlap_add = shape.overlap_add()
            budget = ErrorBudget(shape.fft_samples, shape.overlap)
            pairs, quiet, band_energy, energy = 0, 0, 0.0, 0.0
            for part in blocks.evaluate(self._meanwhile):
                overlap_add.add(part.first, part.samples)
                budget.add(part.first, part.errors)
                pairs += part.pairs
                quiet += part.quiet
                band_energy += part.band_energy
                energy += part.energy
                first, taken = overlap_add.take(part.done if part.done < len(blocks.starts) else None)
                if taken.shape[1]:
                    yield blocks.first_sample + first, blocks.cut.spread(taken), blocks.exponent
                if self._on_block is not None:
                    self._on_block(part.done, len(blocks.starts))
            self._facts = Accumulated(
                budget.norm(blocks.exponent) if shape.bounded else 0.0,
                economy.bins,
                economy.kept,
                pairs,
                band_energy,
                energy,
                self._rows.bank.taps - blocks.cut.taps,
                blocks.cut.weak_actuators,
                quiet,
            )

    @property
    def facts(self) -> Accumulated:
        """What all of it cost and left out, when the last piece was given."""
        if self._facts is None:
            raise RuntimeError("the drives were not made to their end")
        return self._facts

    def add_to(self, drive_v: Float64Array, *, silent: bool) -> Accumulated:
        """Make all of it and add it to drives (actuators, samples) whose first sample is at -(taps - 1).

        Parameters
        ----------
        drive_v : float64 array
            Changed in place.
        silent : bool
            Whether nothing is in it so far, whatever it holds.
        """
        written = 0
        energies = np.zeros(len(drive_v))
        for first, samples, exponent in self.pieces():
            begin, end = max(0, first), min(drive_v.shape[1], first + samples.shape[1])
            if end <= begin:
                continue
            place, found = drive_v[:, begin:end], samples[:, begin - first : end - first]
            if silent:
                drive_v[:, written:begin] = 0
                energies += scale_and_measure(found, exponent, place)
            else:
                place += scale(found, exponent)
            written = end
        if not silent:
            return self.facts
        drive_v[:, written:] = 0
        return replace(self.facts, energies=energies)
