"""Blocks of drives: windows of the source times time-reversed bank rows, summed bin by bin."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.drive.band_choice import choose_economy, quietest, sampled_energy
from rendering.drive.block_size import sample_blocks
from rendering.drive.block_task import BlockShape, BlockTask, Part
from rendering.drive.omission import Economy
from rendering.drive.row_spectra import RowSpectra
from rendering.drive.truncation import SHARE, RowCut, choose_cut
from rendering.drive.upsampling import MULTIPLE, Upsampling, choose_factor
from rendering.drive.windows import Windows
from rendering.greens.bank_rows import BankRows
from rendering.scene.emission import Emission

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]

COARSE = 1e-4
"""Tolerances above this allow to look for what is worth computing in single precision."""
PLANNED_SAMPLES = 2**16
"""Blocks are planned for so many samples at a time."""
PART_VALUES = 2**20
"""Windows and drives of so many numbers are evaluated together: with fewer, the steps from part to part cost more than
what stays in the cache of one core saves."""
AHEAD = 2
"""Parts whose windows, and parts whose blocks, are being transformed while another one is multiplied."""


class Blocks:
    """Evaluates the blocks of one emission, a part by each thread at a time.

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
    workers : Executor
        Threads.
    live : bool
        Look ahead no further than one block.
    expected_rows : int
        About how many bank rows the emission comes from.
    """

    starts: range
    """First samples of the blocks."""
    cut: RowCut
    """What is used of the rows."""
    shape: BlockShape

    def __init__(
        self,
        emission: Emission,
        rows: BankRows,
        transform: Callable[[int], int],
        tolerance: float,
        band_hz: tuple[float, float] | None,
        workers: Executor,
        *,
        live: bool = False,
        expected_rows: int = 0,
    ) -> None:
        self._expected_rows = expected_rows
        self._planned_samples, self._ahead = (1, 0) if live else (PLANNED_SAMPLES, AHEAD)
        self._emission = emission
        self._rows = rows
        self._transform = transform
        self._workers = workers
        self._factor_exponent: int | None = None
        self._quiet = 0.0
        self.cut = RowCut.nothing(rows.bank.taps, rows.bank.actuators)
        self._plan(multiple=MULTIPLE if tolerance > 0 else 1)
        economy = Economy.of(self._fft_samples // 2 + 1)
        self._spectra = RowSpectra(
            rows, self.cut, self._fft_samples, economy, workers, expected_rows=0 if tolerance > 0 else expected_rows
        )
        if tolerance > 0:
            economy = self._economise(tolerance)
        upsampling = None
        factor = choose_factor(self._fft_samples, economy.high) if economy.single else 1
        if factor > 1 and not self._hop % factor:
            upsampling = Upsampling(self._fft_samples, economy.high, self._hop, factor)
        self.shape = BlockShape(
            self._fft_samples,
            self._hop,
            self.cut.actuators,
            economy,
            self._band(band_hz),
            self._peak_ratio(),
            upsampling,
            not economy.exact,
            partial(_sigma, self._rows, self.cut.actuators),
            self._turn(economy),
        )

    @property
    def exponent(self) -> int:
        """Power of two that samples are still to be multiplied with."""
        return self._emission.exponent + (self._factor_exponent or 0)

    @property
    def first_sample(self) -> int:
        """Where the first block's samples begin, in an array of drives whose lead-in is the bank's."""
        return self.starts[0] + self._rows.bank.taps - self.cut.taps

    def evaluate(self, meanwhile: Callable[[], object] | None = None) -> Iterator[Part]:
        """Drives of all blocks, in order.

        Parameters
        ----------
        meanwhile : callable, optional
            Called once, when the first of them are being transformed.
        """
        # Of three tasks, the windows of one and the blocks of another are being transformed.
        begun: deque[BlockTask] = deque()
        multiplied: deque[BlockTask] = deque()
        for task in self._tasks():
            begun.append(task)
            if len(begun) > self._ahead:
                if meanwhile is not None:
                    meanwhile()
                    meanwhile = None
                begun[0].multiply()
                multiplied.append(begun.popleft())
            if len(multiplied) > self._ahead:
                yield multiplied.popleft().finish()
        if meanwhile is not None:
            meanwhile()
        for task in begun:
            task.multiply()
        for task in (*multiplied, *begun):
            yield task.finish()

    def _tasks(self) -> Iterator[BlockTask]:
        """Plan some blocks after the other."""
        at_once = max(1, self._planned_samples // self._hop)
        for first in range(0, len(self.starts), at_once):
            blocks = min(at_once, len(self.starts) - first)
            windows = self._emission.windows(self.starts[first], self._hop, blocks, self._weigh)
            if self._quiet:
                windows.leave_out_quiet(self._rows.norm_of, self._quiet, self._fft_samples)
            yield from self._tasks_of(windows, first, blocks)

    def _tasks_of(self, windows: Windows, first: int, blocks: int) -> Iterator[BlockTask]:
        """Cut planned blocks into parts; a block of very many windows is cut too."""
        shape = self.shape
        most_windows = min(max(1, PART_VALUES // (2 * shape.economy.kept)), self._spectra.most_rows)
        most_blocks = max(1, PART_VALUES // (len(shape.actuators) * shape.samples))
        bounds = np.searchsorted(windows.block, np.arange(blocks + 1))
        block = begin = 0
        while block < blocks:
            stop = int(np.searchsorted(bounds, begin + most_windows, side="right")) - 1
            stop = min(max(stop, block), block + most_blocks, blocks)
            end = int(bounds[stop]) if stop > block else begin + most_windows
            rows = windows.rows[begin:end].tolist()
            self._spectra.prepare(rows)
            part = range(block, max(stop, block + 1))
            view = self._spectra.view(rows)
            yield BlockTask(shape, windows, range(begin, end), part, first, first + stop, view, self._workers)
            block, begin = stop, end

    def _weigh(self, rows: Int64Array, regularised_by: Int64Array) -> tuple[Float64Array, NDArray[np.bool_]]:
        # Rows that are read for their weights are transformed on the spot, lest they be read twice.
        unknown = [row for row in rows.tolist() if not self._rows.knows(row)]
        if len(unknown) <= self._spectra.most_rows:
            self._spectra.prepare(unknown)
        if self._factor_exponent is None and len(rows):
            self._factor_exponent = int(np.frexp(self._rows.weigh(rows[:1], regularised_by[:1])[0][0])[1])
        return self._rows.weigh(rows, regularised_by, self._factor_exponent or 0)

    def _plan(self, *, multiple: int) -> None:
        """Cut the emission into blocks."""
        emission = self._emission
        self._fft_samples = self._transform(self.cut.taps)
        self._hop = self._fft_samples - (self.cut.taps + emission.event_samples - 1) + 1
        if self._hop > multiple:
            self._hop -= self._hop % multiple
        self.starts = range(emission.first_sample, emission.stop_event, self._hop)
        self._overlap = -(-self._fft_samples // self._hop)

    def _economise(self, tolerance: float) -> Economy:
        """Look at some windows of some blocks, and choose what to leave out."""
        # What single precision blurs, a part in ten million, does not change a coarse choice.
        single = tolerance > COARSE
        looked_at = self._all_bins(single=single)
        samples, rows = sample_blocks(self._emission, looked_at, self._weigh, self._fft_samples, self.starts)
        spent = 0.0
        if single:
            self.cut, spent = choose_cut(
                samples,
                rows,
                lambda row: self._rows.read(row, single=True).values,
                (self._rows.bank.actuators, self._rows.bank.taps),
                self._fft_samples,
                self._overlap,
                tolerance,
            )
            energy = sampled_energy(samples) / max(len(samples), 1)
            quiet = SHARE * tolerance * float(np.sqrt(energy / self._overlap))
            if quietest(samples) < quiet:
                self._quiet = quiet
                spent += SHARE * tolerance
        if not self.cut.whole:
            self._plan(multiple=MULTIPLE)
            looked_at = self._all_bins(single=single)
            samples, _ = sample_blocks(self._emission, looked_at, self._weigh, self._fft_samples, self.starts)
        economy = choose_economy(samples, self._fft_samples, self._overlap, tolerance, spent)
        if economy.exact:
            self.cut, self._quiet = RowCut.nothing(self._rows.bank.taps, self._rows.bank.actuators), 0.0
            self._plan(multiple=MULTIPLE)
            economy = Economy.of(self._fft_samples // 2 + 1)
        known = looked_at if economy.single == single else None
        self._spectra = RowSpectra(
            self._rows, self.cut, self._fft_samples, economy, self._workers, known, self._expected_rows
        )
        return economy

    def _all_bins(self, *, single: bool) -> RowSpectra:
        economy = Economy.of(self._fft_samples // 2 + 1, single=single)
        self._spectra = RowSpectra(self._rows, self.cut, self._fft_samples, economy, self._workers)
        return self._spectra

    def _band(self, band_hz: tuple[float, float] | None) -> slice:
        if band_hz is None:
            return slice(0, 0)
        frequency = scipy_fft.rfftfreq(self._fft_samples, 1.0 / self._rows.bank.sample_rate_hz)
        first = np.searchsorted(frequency, band_hz[0], side="left")
        return slice(int(first), int(np.searchsorted(frequency, band_hz[1], side="right")))

    def _peak_ratio(self) -> float:
        # A window has hop + event - 1 samples, so that its spectrum is a trigonometric polynomial of half that
        # degree (Ehlich and Zeller: its largest value, over the largest at equidistant points).
        degree = (self._hop + self._emission.event_samples - 2) / 2.0
        return float(1.0 / np.cos(np.pi * degree / self._fft_samples))

    def _turn(self, economy: Economy) -> NDArray[Any]:
        cycle = (self.cut.taps - 1) * np.arange(economy.low, economy.high) % self._fft_samples
        turn: NDArray[Any] = np.exp(-2j * np.pi / self._fft_samples * cycle).astype(economy.complex)
        return turn


def _sigma(rows: BankRows, actuators: Int64Array, by: int) -> Float64Array:
    """Saturation factors of some actuators; no method, lest blocks hold themselves and memory be kept from reuse."""
    sigma = rows.sigma(by)
    return np.ones(len(actuators)) if sigma is None else sigma[actuators]
