"""Interpolation by waves from the actuators and from the rim (`wavefocus.calibration.coarse_grid`).

It works on grids coarser than half a wavelength, where the kernel does not. The model is fitted once for a bank and
kept next to it.
"""

import hashlib
import logging
from dataclasses import dataclass, fields
from pathlib import Path as FilePath
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from wavefocus.calibration.coarse_grid.bounds import MIN_CHECKS
from wavefocus.calibration.coarse_grid.rim_waves import MIN_POSITIONS, RimWaves
from wavefocus.calibration.estimator.noise_error import bank_noise_error_db, noise_share
from wavefocus.calibration.evidence import MOST
from wavefocus.calibration.numerics import on_a_line, one_blas_thread
from wavefocus.rendering.arrays import BoolArray, Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.base import Estimate, kept
from wavefocus.rendering.greens.interpolation.path_nodes import (
    PATH_ERROR,
    AddedRows,
    PathInterpolation,
    node_spacing_mm,
)
from wavefocus.rendering.greens.source import GreenSource, RowReader, is_check, usable_checks, well_measured
from wavefocus.storage.bank.reading import Bank
from wavefocus.storage.errors import InputError
from wavefocus.storage.wave_file import read_wave_file, wave_file, write_wave_file

LOG = logging.getLogger("wavefocus")
_RECIPE = 7
"""Raised when the same bank gives another model, so that no older file is used."""
EDGE = 1.2
"""The band is modelled to this factor beyond its ends, where a bank still holds a little: a quarter octave."""
ROWS_AT_ONCE = 512
"""Rows that are made together, and that are kept; most of the time goes into functions of distance."""


@dataclass(frozen=True, slots=True)
class _BankWaves:
    """The model of one bank.

    model: Of the bank's rows.
    samples: Length of the transform whose bins the model is of.
    lowest_bin: Index of its first frequency.
    """

    model: RimWaves
    samples: int
    lowest_bin: int


class _WaveRows(AddedRows):
    """A bank and, behind its own positions, rows that the waves give at other points."""

    def __init__(self, measured: GreenSource, waves: _BankWaves) -> None:
        super().__init__(measured, ROWS_AT_ONCE)
        self._waves = waves

    def _make(self, number: int) -> dict[int, Float64Array]:
        # Rows are mostly read in the order in which they were added.
        numbers = range(number, min(number + ROWS_AT_ONCE, self.added))
        values = self._waves.model.values(np.array([self._points_mm[one] for one in numbers]))
        spectra = np.zeros((len(numbers), self.actuators, self._waves.samples // 2 + 1), dtype=np.complex128)
        first = self._waves.lowest_bin
        spectra[:, :, first : first + len(values)] = values.transpose(1, 2, 0)
        green = scipy_fft.irfft(spectra, self._waves.samples, axis=2)[:, :, : self.taps]
        return dict(zip(numbers, green, strict=True))


class WavesInterpolation(PathInterpolation):
    """Waves from each actuator and from the rim, with a standard deviation (`wavefocus.calibration.coarse_grid`).

    Raises InputError: the bank lacks an actuator's place, or its positions are too few or on one line.
    """

    name = "waves"

    def __init__(self, bank: GreenSource) -> None:
        _require_modelled(bank, well_measured(bank))
        super().__init__(bank)
        self.waves = _bank_waves(bank)
        self.rows = _WaveRows(bank, self.waves)
        self.node_spacing_mm = node_spacing_mm(float(np.abs(self.waves.model.wavenumber).max()), PATH_ERROR)

    @classmethod
    def over(cls, bank: GreenSource, around_mm: Float64Array) -> Self:
        return cls(bank)

    def estimate(self, bank: GreenSource, points_mm: Float64Array, frequency_hz: Float64Array) -> Estimate:
        """At the modelled frequencies nearest to those given."""
        model = self.waves.model
        index = [int(np.argmin(np.abs(model.frequency_hz - hz))) for hz in frequency_hz]
        with one_blas_thread():
            values, deviations = model.values(points_mm, index), model.deviations(points_mm, index)
        expected, bound = (scale[index, None, None] * deviations for scale in (model.error_scale, model.bound_scale))
        level = np.hypot(np.linalg.norm(values, axis=2), np.linalg.norm(expected, axis=2))
        return Estimate(values, expected, bound, level, model.judged_by, _bound_words(model, index))


def _bound_words(model: RimWaves, index: list[int]) -> str:
    if not model.stated:
        return f"no bound: the bank has fewer than {MIN_CHECKS} check positions"
    limited = (model.by_noise[index] > MOST).any()
    words = f"holds {model.stated:.0%} of the errors at random places over the surface, and says nothing of one place"
    return f"{words}; limited by noise of the check positions, and too wide" if limited else words


def _require_modelled(bank: GreenSource, allowed: BoolArray) -> None:
    """Raise InputError where the waves cannot be modelled."""
    unknown = ~np.isfinite(np.asarray(bank.actuator_mm)).all(axis=1)
    if unknown.any():
        raise InputError(
            f"interpolation is 'waves', but the bank does not say where actuator {int(np.argmax(unknown))} is;"
            " /actuator_mm must hold its place, or use 'kernel' or 'nearest'"
        )
    position_mm = np.unique(np.asarray(bank.position_mm, dtype=np.float64)[allowed], axis=0)
    if len(position_mm) < MIN_POSITIONS or on_a_line(position_mm):
        raise InputError(
            f"interpolation is 'waves', but the {len(position_mm)} measured positions are too few or lie on one line;"
            f" it needs at least {MIN_POSITIONS}, spread in two directions; use 'nearest'"
        )


_models: dict[str, _BankWaves] = {}


def _bank_waves(bank: GreenSource) -> _BankWaves:
    """The model of a bank: of this process, from the file next to the bank, or fitted and kept there.

    What is kept belongs to the bank's contents, by their hash; if they change, it is fitted anew.
    """
    key = _contents_sha256(bank)

    def made() -> _BankWaves:
        path = getattr(bank, "path", None)
        arrays = read_wave_file(wave_file(path), key, _NAMES) if isinstance(path, FilePath) else None
        found = None if arrays is None else _of_arrays(arrays, bank)
        if found is None:
            positions = int(np.count_nonzero(well_measured(bank)))
            # Processor time of a fit: 22 s of 45 positions and 12 actuators, 36 to 72 s of 170 to 220.
            LOG.warning(
                "fitting waves to %d positions: about %d s of processor time, once; kept next to the bank",
                positions, 10.0 + 0.2 * positions,
            )  # fmt: skip
            found = _fit(bank)
            if isinstance(path, FilePath):
                write_wave_file(wave_file(path), key, _arrays(found))
        return found

    return kept(_models, key, made, 4)


def _contents_sha256(bank: GreenSource) -> str:
    """Hash of all that the model depends on; every row that is used is read, so a damaged one is refused."""
    digest = hashlib.sha256(f"{_RECIPE} {bank.sample_rate_hz!r} {bank.taps} {bank.band_hz!r}".encode())
    used = well_measured(bank) | usable_checks(bank)
    for values in (bank.position_mm, bank.actuator_mm, used, is_check(bank)):
        digest.update(np.ascontiguousarray(values).tobytes())
    for row in np.flatnonzero(used).tolist():
        digest.update(np.ascontiguousarray(bank.green(row)).tobytes())
    return digest.hexdigest()


def _fit(bank: GreenSource) -> _BankWaves:
    reader = RowReader(bank)
    allowed, checks = well_measured(bank), usable_checks(bank)
    position_mm = np.asarray(bank.position_mm, dtype=np.float64)
    # A position that was measured twice counts once.
    _, first = np.unique(position_mm[allowed], axis=0, return_index=True)
    rows = np.flatnonzero(allowed)[np.sort(first)]
    # Share of the taps that the transform is longer, so that what would come before the first tap does not wrap round.
    samples = int(scipy_fft.next_fast_len(round(1.08 * bank.taps), real=True))
    bins_hz = scipy_fft.rfftfreq(samples, 1.0 / float(bank.sample_rate_hz))
    low_hz, high_hz = bank.band_hz if bank.band_hz is not None else (0.0, np.inf)
    chosen = np.flatnonzero((bins_hz >= max(low_hz / EDGE, bins_hz[1])) & (bins_hz <= min(high_hz * EDGE, bins_hz[-2])))
    spectra = _spectra(reader, rows, samples, chosen)
    power = np.square(np.abs(spectra)).mean(axis=(1, 2))
    if not power.max() > 0:
        raise InputError("interpolation is 'waves', but all Green's functions of the bank are zero; use 'nearest'")
    # Frequencies with less of the loudest one's power are left out.
    loud = np.flatnonzero(power > 1e-5 * power.max())
    inside = slice(int(loud[0]), int(loud[-1]) + 1)
    try:
        model = RimWaves.fit(
            bins_hz[chosen[inside]], position_mm[rows], np.asarray(bank.actuator_mm, dtype=np.float64), spectra[inside],
            position_mm[checks], _spectra(reader, np.flatnonzero(checks), samples, chosen[inside]),
            _spectral_noise(bank, reader, np.flatnonzero(checks)),
            band_hz=bank.band_hz, resolution_hz=float(bank.sample_rate_hz) / bank.taps,
        )  # fmt: skip
    except np.linalg.LinAlgError as error:
        raise InputError(f"interpolation is 'waves', but no waves fit the bank ({error}); use 'nearest'") from error
    return _BankWaves(model, samples, int(chosen[inside][0]))


def _spectral_noise(bank: GreenSource, reader: RowReader, rows: Int64Array) -> Float64Array | None:
    """Standard deviation of the noise in the transfer functions of rows, (rows, actuators); None where unknown."""
    noise_db = bank_noise_error_db(bank) if isinstance(bank, Bank) else None
    if noise_db is None or bank.band_hz is None or not len(rows):
        return None
    low_hz, high_hz = bank.band_hz
    energy = np.stack([np.square(reader.read(row)).sum(axis=1) for row in rows.tolist()])
    # White within the band, its energy is spread over that much of the spectrum.
    share = float(bank.sample_rate_hz) / (2.0 * max(high_hz - low_hz, 1e-9))
    return np.asarray(np.sqrt(energy * noise_share(noise_db[rows]) * share))


def _spectra(reader: RowReader, rows: Int64Array, samples: int, bins: Int64Array) -> Complex128Array:
    """Transfer functions of rows, (bins, rows, actuators)."""
    found = np.empty((len(bins), len(rows), reader.bank.actuators), dtype=np.complex128)
    for place, row in enumerate(rows.tolist()):
        found[:, place] = scipy_fft.rfft(reader.read(row), samples, axis=1)[:, bins].T
    return found


_COMPLEX = {"wavenumber": np.complex128, "strength": np.complex64, "rest": np.complex64}
_NUMBERS = ("pressure_share", "stated")
_FACTS = ("samples", "lowest_bin")
_NAMES = (*_FACTS, *(field.name for field in fields(RimWaves)))


def _arrays(waves: _BankWaves) -> dict[str, NDArray[Any]]:
    arrays = {name: np.asarray(getattr(waves, name)) for name in _FACTS}
    for name in _NAMES[len(_FACTS) :]:
        value = getattr(waves.model, name)
        values = np.frombuffer(value.encode(), np.uint8) if isinstance(value, str) else np.ascontiguousarray(value)
        # Files of this program hold real numbers only.
        arrays[name] = values.view(values.real.dtype) if np.iscomplexobj(values) else values
    return arrays


def _of_arrays(arrays: dict[str, NDArray[Any]], bank: GreenSource) -> _BankWaves | None:
    """The model that a file holds; None where its arrays do not fit each other or the bank."""
    try:
        kept: dict[str, Any] = {name: arrays[name] for name in _NAMES[len(_FACTS) :]}
        for name, kind in _COMPLEX.items():
            kept[name] = np.ascontiguousarray(kept[name]).view(kind)
        kept |= {name: float(kept[name].item()) for name in _NUMBERS}
        kept["judged_by"] = kept["judged_by"].tobytes().decode()
        model = RimWaves(**kept)
        model.require_sound(bank.actuators)
        facts = [int(arrays[name].item()) for name in _FACTS]
    except (ValueError, TypeError, AttributeError):
        return None
    fits = facts[0] >= bank.taps and 0 <= facts[1] <= facts[0] // 2 + 1 - len(model.frequency_hz)
    return _BankWaves(model, *facts) if fits else None
