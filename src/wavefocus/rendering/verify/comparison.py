"""One pass over a predicted and a measured field: errors, correlations, snapshots, waveforms."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.arrays import Complex128Array, Float32Array, Float64Array, Int64Array
from wavefocus.rendering.field.foci import FocusInstant, emission_windows, focus_instants
from wavefocus.rendering.field.metrics import RealArray, level_db
from wavefocus.rendering.verify.field_pair import MAX_DELAY_S, BandLimit
from wavefocus.rendering.verify.scan import Scan
from wavefocus.storage.bank.ledger import Status
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource
    from wavefocus.storage.drive_file import Drive
    from wavefocus.storage.field_file import Field

# Positions per step of the pass: a few MB for seconds of signal.
_CHUNK_POSITIONS = 64


# Frequencies at which causes of a difference are looked for: those at which the drive is loudest.
_MAX_FREQUENCIES = 128
MIN_POWER = 1e-6
"""Quieter bins say nothing."""


@dataclass(frozen=True, slots=True)
class _FieldSpectra:
    """Both fields, limited to the band, and the drive, at some frequencies (K,), for each compared position (P,).

    drive, complex128 (actuators, K); predicted, scanned, complex64 (P, K): Sums over samples from the first on.
    noise, float64 (P,): Energy of the scan's noise at these frequencies; NaN where unknown.
    """

    frequency_hz: Float64Array
    drive: Complex128Array
    predicted: NDArray[np.complex64]
    scanned: NDArray[np.complex64]
    noise: Float64Array


@dataclass(frozen=True, slots=True)
class FieldComparison:
    """A predicted and a measured field, compared within `band_hz` (None: not limited).

    error, error_all_frequencies: ``||scan - prediction|| / ||scan||`` over all compared positions and samples; without
        limiting the band.
    correlation: Zero-lag correlation over all compared positions and samples.
    level_db: Gain that fits the prediction best to the scan, ``<scan, prediction> / ||prediction||**2``.
    delay_samples: Delay of the scan: the peak, within 20 ms, of the cross-correlation summed over positions.
    position_index, int64 (P,): Compared bank rows, ascending.
    position_mm, float64 (P, 2): Their places.
    position_error, position_correlation, float64 (P,): NaN where the scan is silent.
    position_scanned, position_noise, float64 (P,): Norm over samples of the scan and of its noise; NaN noise where
        unknown.
    excluded: Scanned bank rows that were not compared, and why.
    predicted_snapshot, scanned_snapshot, float32 (focus instants, P): The fields at those instants.
    waveform_index, int64 (W,): Bank rows of path points whose waveforms, (W, samples) each, are kept.
    spectra: Both fields at some frequencies.
    """

    band_hz: tuple[float, float] | None
    sample_rate_hz: float
    start_s: float
    response_unit: str
    error: float
    error_all_frequencies: float
    correlation: float
    level_db: float
    delay_samples: float
    position_index: Int64Array
    position_mm: Float64Array
    position_error: Float64Array
    position_correlation: Float64Array
    position_scanned: Float64Array
    position_noise: Float64Array
    excluded: tuple[tuple[int, str], ...]
    instant: tuple[FocusInstant, ...]
    predicted_snapshot: Float32Array
    scanned_snapshot: Float32Array
    waveform_index: Int64Array
    predicted_waveform: Float32Array
    scanned_waveform: Float32Array
    spectra: _FieldSpectra

    @property
    def correlation_median(self) -> float:
        """Median over positions of the correlation at each."""
        return float(np.nanmedian(self.position_correlation))


def compare_fields(prediction: Field, scan: Scan, drive: Drive, bank: GreenSource) -> FieldComparison:
    """Compare fields where both have positions, the record is sound and the bank's row is valid.

    Raises InputError: the fields do not belong together, or no position can be compared.
    """
    _check_grids(prediction, scan)
    rows, in_prediction, in_scan, excluded = _compared_rows(prediction, scan, bank)
    rate_hz, samples = scan.sample_rate_hz, scan.field.shape[1]
    first_sample = round(scan.start_s * rate_hz)
    band = BandLimit(samples, rate_hz, bank.band_hz)

    windows = [window for window in emission_windows(drive) if window.start_sample - first_sample < samples]
    compared = np.isin([window.row for window in windows], rows)
    at_foci = np.full((len(windows), samples), np.nan, np.float32)
    if compared.any():
        focus_rows = np.array([window.row for window in windows])[compared]
        at_foci[compared] = band.signals(
            band.spectrum(prediction.field[in_prediction[np.searchsorted(rows, focus_rows)]])
        )
    instants = focus_instants(tuple(windows), at_foci, first_sample)
    columns = np.array([instant.sample - first_sample for instant in instants], np.int64)
    focused = np.unique([instant.row for instant in instants if instant.row in rows]).astype(np.int64)
    waveform_index = focused[evenly_spread(len(focused), 6)]

    scanned_energy, predicted_energy, product, error_energy = np.zeros((4, rows.size))
    raw_error = raw_scanned = 0.0
    snapshots = np.zeros((2, len(instants), rows.size), np.float32)
    waveforms = np.zeros((2, waveform_index.size, samples), np.float32)
    cross = np.zeros(band.bins, np.complex128)
    chosen, drive_spectra = _loudest(drive, band)
    at_chosen = np.zeros((2, rows.size, chosen.size), np.complex64)
    for first in range(0, rows.size, _CHUNK_POSITIONS):
        part = slice(first, first + _CHUNK_POSITIONS)
        predicted = prediction.field[in_prediction[part]]
        scanned = scan.field[in_scan[part]]
        raw_error += float(np.sum(_energy(scanned - predicted)))
        raw_scanned += float(np.sum(_energy(scanned)))
        spectra = band.spectrum(predicted), band.spectrum(scanned)
        cross += np.sum(spectra[0].conj() * spectra[1], axis=0)
        at_chosen[:, part] = spectra[0][:, chosen], spectra[1][:, chosen]
        predicted, scanned = band.signals(spectra[0]), band.signals(spectra[1])
        scanned_energy[part], predicted_energy[part] = _energy(scanned), _energy(predicted)
        product[part] = np.einsum("ps,ps->p", scanned, predicted, dtype=np.float64)
        error_energy[part] = _energy(scanned - predicted)
        snapshots[:, :, part] = predicted[:, columns].T, scanned[:, columns].T
        here = np.flatnonzero(np.isin(waveform_index, rows[part]))
        of_chunk = np.searchsorted(rows[part], waveform_index[here])
        waveforms[:, here] = predicted[of_chunk], scanned[of_chunk]

    with np.errstate(divide="ignore", invalid="ignore"):
        position_error = np.sqrt(error_energy / scanned_energy)
        position_correlation = product / np.sqrt(scanned_energy * predicted_energy)
    noise_rms = scan.noise_rms[in_scan]
    return FieldComparison(
        band_hz=bank.band_hz,
        sample_rate_hz=rate_hz,
        start_s=scan.start_s,
        response_unit=scan.response_unit,
        error=_root_ratio(error_energy.sum(), scanned_energy.sum()),
        error_all_frequencies=_root_ratio(raw_error, raw_scanned),
        correlation=_ratio(product.sum(), math.sqrt(scanned_energy.sum() * predicted_energy.sum())),
        level_db=level_db(max(_ratio(product.sum(), predicted_energy.sum()), 0.0)),
        delay_samples=band.delay_samples(cross, round(MAX_DELAY_S * rate_hz)),
        position_index=rows,
        position_mm=np.asarray(bank.position_mm, np.float64)[rows],
        position_error=position_error,
        position_correlation=position_correlation,
        position_scanned=np.sqrt(scanned_energy),
        position_noise=noise_rms * math.sqrt(samples * band.white_share),
        excluded=excluded,
        instant=instants,
        predicted_snapshot=snapshots[0],
        scanned_snapshot=snapshots[1],
        waveform_index=waveform_index,
        predicted_waveform=waveforms[0],
        scanned_waveform=waveforms[1],
        spectra=_FieldSpectra(
            frequency_hz=np.asarray(band.frequency_hz[chosen], np.float64),
            drive=drive_spectra,
            predicted=at_chosen[0],
            scanned=at_chosen[1],
            noise=np.asarray(noise_rms**2 * samples * band.power_of_white(chosen), np.float64),
        ),
    )


def _loudest(drive: Drive, band: BandLimit) -> tuple[Int64Array, Complex128Array]:
    """Frequency bins at which the drive is loudest within the band, and its spectra there, (actuators, bins)."""
    spectra = np.stack([band.spectrum(signal) for signal in drive.drive_v]).astype(np.complex128)
    power = np.square(np.abs(spectra)).sum(axis=0)
    loudest = np.sort(np.argsort(power)[::-1][:_MAX_FREQUENCIES])
    chosen = loudest[power[loudest] > MIN_POWER * power.max()]
    chosen = chosen if chosen.size else np.zeros(1, np.int64)
    return chosen, spectra[:, chosen]


def _check_grids(prediction: Field, scan: Scan) -> None:
    if prediction.low_pass is not None:
        raise InputError(
            f"the prediction is at a rate {prediction.low_pass.factor} times lower than the bank's, low-passed above"
            f" {prediction.low_pass.passed_hz:g} Hz; predict at the bank's rate to compare it with a scan"
        )
    for name, predicted, scanned in (
        ("sample_rate_hz", prediction.sample_rate_hz, scan.sample_rate_hz),
        ("start_s", prediction.start_s, scan.start_s),
        ("samples", prediction.field.shape[1], scan.field.shape[1]),
    ):
        if predicted != scanned:
            raise InputError(
                f"{name} of the prediction is {predicted} and of the scan {scanned}; "
                "they must be equal: predict and scan the same drive with the same bank"
            )


def _compared_rows(
    prediction: Field, scan: Scan, bank: GreenSource
) -> tuple[Int64Array, Int64Array, Int64Array, tuple[tuple[int, str], ...]]:
    """Compared bank rows, their places in prediction and scan, and the rows left out with the reason."""
    reasons: dict[int, str] = {}
    for row, status in zip(scan.position_index, scan.status, strict=True):
        if status & Status.FAILED:
            reasons[int(row)] = "the scan failed"
        elif status & Status.OVER_RANGE:
            reasons[int(row)] = "the scan reached the end of the input range"
        elif status & Status.POOR_SIGNAL:
            reasons[int(row)] = "the vibrometer lost the signal in the scan"
        elif bank.status[row] != Status.VALID:
            reasons[int(row)] = "the bank's row is not valid"
    rows, in_prediction, in_scan = np.intersect1d(
        prediction.position_index, scan.position_index, assume_unique=True, return_indices=True
    )
    sound = np.array([int(row) not in reasons for row in rows], bool)
    if not sound.any():
        raise InputError(
            f"prediction ({len(prediction.position_index)} positions) and scan ({len(scan.position_index)} "
            "positions) have no position in common that is valid in both; at least one is needed"
        )
    return rows[sound].astype(np.int64), in_prediction[sound], in_scan[sound], tuple(sorted(reasons.items()))


def _energy(signals: RealArray) -> Float64Array:
    return np.asarray(np.einsum("ps,ps->p", signals, signals, dtype=np.float64))


def _ratio(numerator: float, denominator: float) -> float:
    return float(numerator / denominator) if denominator > 0.0 else math.nan


def _root_ratio(numerator: float, denominator: float) -> float:
    if denominator > 0.0:
        return math.sqrt(numerator / denominator)
    return 0.0 if numerator == 0.0 else math.inf
