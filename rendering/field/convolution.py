"""Many rows of a bank convolved with one drive."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from rendering.drive.band_choice import Sample, choose_economy
from rendering.drive.drive_blocks import DriveBlocks
from rendering.drive.drive_cut import CutDrive
from rendering.drive.omission import LEAST_NORM, Economy
from rendering.drive.row_transforms import BankSpectra
from rendering.drive.upsampling import MULTIPLE, choose_factor
from rendering.greens.source import RowReader
from storage.errors import InputError

Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]
RealArray = NDArray[np.float32] | NDArray[np.float64]

PART_BYTES = 6 * 2**20
"""What is under way for one part of the field; calling a matrix product costs about as much as ten rows."""
LEAST_HOP_SAMPLES = 512
HOPS = (0.25, 0.375, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
"""Hops that are weighed, relative to the taps."""
PRODUCT = 2.0
"""What a bin of a product costs, in samples of a transform times factors of 2 (measured in complex64)."""
KEPT_SHARE = 0.3
"""Share of the bins, and of the rate, that a tolerance is likely to leave."""
FADE_SHARE = 0.09
"""Share of a block over which it fades into the next."""
LOOKED_AT_EVERY = 64
"""Samples of a drive to the first that is looked at for its size."""
SAMPLED_ROWS = 3
SAMPLED_BLOCKS = 2
KEPT_PART_BYTES = 16 * 2**20
"""The same where the rows' spectra are there already."""
PLAIN_EXPONENT = 40
"""Responses times powers of two below this fit float32, and so do their squares."""


@dataclass(frozen=True, slots=True)
class Response:
    """Responses at some positions.

    Parameters
    ----------
    field : float32 or float64 array, shape (positions, samples)
    error : float
        Bound on the norm of all their error from leaving out.
    energy : float
        Their energy, where such a bound is asked for.
    """

    field: RealArray
    error: float
    energy: float


class Convolution:
    """Convolves rows of the bank with the drive, block by block, a matrix product per frequency bin.

    `respond` may be called by several threads.

    Parameters
    ----------
    drive_v : float64 array, shape (actuators, samples)
        The drives, finite.
    reader : RowReader
        Reads the rows.
    dtype : dtype
        float32 or float64: of samples, and of the spectra's parts where nothing is left out.
    positions : int64 array
        Rows that will be asked for.
    tolerance : float
        Relative magnitude of what may be left out of each part of the field; 0: nothing is.
    spectra : BankSpectra, optional
        Spectra of the rows, kept from earlier; then `tolerance` is theirs.

    Raises
    ------
    InputError
        The drive holds NaN or infinity.
    """

    samples: int
    """Samples of a response: drive samples + taps - 1."""
    rows_at_once: int
    """Rows to ask for at a time."""

    def __init__(
        self,
        drive_v: Float64Array,
        reader: RowReader,
        dtype: np.dtype[Any],
        positions: Int64Array | Sequence[int] = (),
        tolerance: float = 0.0,
        spectra: BankSpectra | None = None,
    ) -> None:
        self._reader = reader
        self._dtype = dtype
        self.samples = int(drive_v.shape[1]) + reader.taps - 1
        self._making = threading.Lock()
        self._whole: DriveBlocks | None = None
        self._spectra = spectra
        self._economical: DriveBlocks | None = None
        self._tolerance = tolerance
        if spectra is not None and tolerance:
            # Some samples tell the size without a pass over all; what they do not tell shows in the blocks' spectra.
            sizes = _sizes(drive_v[:, ::LOOKED_AT_EVERY])
            if sizes.all():
                self._scale(drive_v, sizes)
                blocks = self._as_kept(spectra)
                self._economical = blocks if blocks.plain else None
        if self._economical is None:
            self._scale(drive_v, _sizes(drive_v))
            if len(self._heard) and spectra is not None:
                self._economical = self._as_kept(spectra)
            elif len(self._heard) and tolerance:
                self._economical = self._economise(np.asarray(positions, dtype=np.int64))
        self.rows_at_once = 1
        if len(self._heard):
            most_bytes = KEPT_PART_BYTES if spectra is not None else PART_BYTES
            self.rows_at_once = max(1, most_bytes // (self._economical or self._complete()).part_bytes())

    def _scale(self, drive_v: Float64Array, sizes: Float64Array) -> None:
        """Take the drives that are not silent, by powers of two, so that single precision holds any bank and drive."""
        self._heard = np.flatnonzero(sizes)
        self._exponent = int(np.frexp(float(sizes.max(initial=0.0)))[1])
        heard = drive_v if len(self._heard) == len(drive_v) else drive_v[self._heard]
        self._drive = CutDrive(heard, self._exponent)

    @property
    def kept_share(self) -> float:
        """Share of the frequency bins that is computed."""
        economy = self._economical.economy if self._economical else None
        return economy.kept / economy.bins if economy else 1.0

    @property
    def padded_samples(self) -> int:
        """Samples of a response and some more, as `respond` makes them best."""
        return self._economical.padded_samples if self._economical else self.samples

    def respond(self, positions: Int64Array, out: RealArray | None = None) -> Response:
        """Responses at some positions.

        Parameters
        ----------
        positions : int64 array, shape (k,)
            Bank rows.
        out : array, shape (k, `padded_samples`), optional
            Gets the responses, of the type asked for.
        """
        if not len(self._heard):
            return self._placed(np.zeros((len(positions), self.samples), dtype=self._dtype), out, 0.0, 0.0)
        if self._economical:
            fits = out is not None and out.dtype == self._economical.economy.real
            field, error, energy = self._respond(positions, self._economical, out if fits else None)
            known = energy < np.inf
            if not self._tolerance or (known and error <= self._tolerance * (np.sqrt(energy) - error)):
                return self._placed(field, None if fits else out, error, energy)
        field, _, _ = self._respond(positions, self._complete(), None)
        energy = float(np.einsum("ij,ij->", field, field, dtype=np.float64)) if self._tolerance else 0.0
        return self._placed(field, out, 0.0, energy)

    def _placed(self, field: RealArray, out: RealArray | None, error: float, energy: float) -> Response:
        if out is None:
            return Response(field.astype(self._dtype, copy=False), error, energy)
        out[:, : field.shape[1]] = field
        return Response(out[:, : field.shape[1]], error, energy)

    def _respond(
        self, positions: Int64Array, blocks: DriveBlocks, out: RealArray | None
    ) -> tuple[RealArray, float, float]:
        if self._spectra is not None and blocks is self._economical:
            rows = self._spectra.rows(positions).heard(self._heard)
        else:
            rows = blocks.transform(self._reader, positions.tolist(), self._heard)
        exponents = rows.exponents
        total = exponents + self._exponent
        plain = np.abs(total) < PLAIN_EXPONENT
        with np.errstate(over="ignore", under="ignore"):
            field, errors, energies = blocks.convolve(rows, np.where(plain, np.ldexp(1.0, total), 1.0), out)
            for place in np.flatnonzero(~plain).tolist():
                # In two steps: the sum of two large exponents may lie beyond what one factor can hold.
                for values, power in ((field, 1), (errors, 1), (energies, 2)):
                    values[place] = np.ldexp(np.ldexp(values[place], power * exponents[place]), power * self._exponent)
        if not plain.all() and not np.isfinite(field).all():
            bad = int(np.argmin(np.isfinite(field).all(axis=1)))
            raise InputError(
                f"the response at position {positions[bad]} does not fit into {self._dtype}; lower the drive's scale"
            )
        return field, float(np.linalg.norm(errors)), float(energies.sum())

    def _complete(self) -> DriveBlocks:
        """Blocks of which nothing is left out."""
        with self._making:
            if self._whole is None:
                samples = self._fft_samples(1)
                economy = Economy.of(samples // 2 + 1, single=self._dtype == np.float32)
                hop = samples - self._reader.taps + 1
                self._whole = DriveBlocks(self._drive, self._reader.taps, samples, hop, economy)
            return self._whole

    def _as_kept(self, spectra: BankSpectra) -> DriveBlocks:
        """Blocks that the bank's spectra can be multiplied with."""
        economy, fft_samples, taps = spectra.economy, spectra.fft_samples, self._reader.taps
        hop, fade, factor = fft_samples - taps + 1, 0, 1
        faded = _faded(hop) if economy.kept < economy.bins else (0, 0)
        if faded[0]:
            hop, fade = faded
            factor = choose_factor(fft_samples, economy.high) if economy.single else 1
        bounded = bool(self._tolerance)
        # The drive's transforms are a good part of the work where the rows' are there already.
        return DriveBlocks(self._drive, taps, fft_samples, hop, economy, fade, factor, bounded=bounded, double=False)

    def _economise(self, positions: Int64Array) -> DriveBlocks | None:
        """Blocks of which so much is left out as the tolerance allows by a look at some rows; None if nothing."""
        fft_samples, taps = self._fft_samples(MULTIPLE), self._reader.taps
        hop, fade = _faded(fft_samples - taps + 1)
        if not hop:
            return None
        blocks = -(-self._drive.samples // hop)
        some = np.unique(np.linspace(0, blocks - 1, SAMPLED_BLOCKS).astype(int))
        windows = []
        for block in some.tolist():
            cut = np.empty((self._drive.actuators, hop + fade), dtype=np.float32)
            self._drive.cut(block, hop, fade, cut)
            windows.append(_magnitudes(cut, fft_samples))
        samples = []
        chosen = positions[np.unique(np.linspace(0, len(positions) - 1, SAMPLED_ROWS).astype(int))]
        for position in chosen.tolist():
            greens = _magnitudes(self._reader.read(position, single=True).values[self._heard], fft_samples)
            samples += [Sample(window, greens, 1.0, np.zeros(len(window))) for window in windows]
        economy = choose_economy(samples, fft_samples, -(-fft_samples // hop), self._tolerance)
        if economy.exact:
            return None
        factor = choose_factor(fft_samples, economy.high) if economy.single else 1
        factor = factor if hop % factor == 0 else 1
        return DriveBlocks(self._drive, taps, fft_samples, hop, economy, fade, factor, bounded=True)

    def _fft_samples(self, multiple: int) -> int:
        """Transform length that costs least per row: a transform per actuator, a product and one back per block."""
        taps, samples, actuators = self._reader.taps, self._drive.samples, self._drive.actuators
        share = 1.0 if multiple == 1 else KEPT_SHARE
        best, least = 0, np.inf
        for hop in sorted({min(samples, max(LEAST_HOP_SAMPLES, int(part * taps))) for part in HOPS}):
            length = multiple * int(scipy_fft.next_fast_len(-(-(taps + hop - 1) // multiple), real=True))
            blocks = -(-samples // (length - taps + 1))
            transforms = length * np.log2(length) * (actuators + share * blocks)
            cost = transforms + share * PRODUCT * length * actuators * blocks / 2
            if cost < least:
                best, least = length, cost
        return best


def _faded(room: int) -> tuple[int, int]:
    """Hop and fade of blocks with so many samples to themselves; no hop where there is no room."""
    fade = int(FADE_SHARE * room)
    return (room - fade) // MULTIPLE * MULTIPLE, fade


def _sizes(drive_v: Float64Array) -> Float64Array:
    """Size of each actuator's drive: its norm, or its peak where that is not a plain number."""
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        sizes: Float64Array = np.sqrt(np.einsum("ij,ij->i", drive_v, drive_v))
    for place in np.flatnonzero(~((sizes > LEAST_NORM) & (sizes < np.inf))).tolist():
        sizes[place] = max(drive_v[place].max(initial=0.0), -drive_v[place].min(initial=0.0))
    if not np.isfinite(sizes).all():
        raise InputError("the drive holds NaN or infinity; render it again")
    return sizes


def _magnitudes(values: RealArray, fft_samples: int) -> Float64Array:
    """Magnitudes of spectra, without the care that numpy's abs takes."""
    parts = np.square(scipy_fft.rfft(values.astype(np.float32, copy=False), fft_samples, axis=1).view(np.float32))
    magnitudes: Float64Array = np.sqrt(parts[:, ::2] + parts[:, 1::2], dtype=np.float64)
    return magnitudes
