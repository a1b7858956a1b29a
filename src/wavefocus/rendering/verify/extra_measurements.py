"""What is measured beside the scan: the sentinel position for what has changed since, a quieter scan for linearity."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.acquisition.attempt import as_measured
from wavefocus.acquisition.drift_watch import says_nothing
from wavefocus.acquisition.engine.session import Session, StopRequest
from wavefocus.acquisition.engine.station import Station
from wavefocus.acquisition.limits import compare_sentinel
from wavefocus.acquisition.plan import Plan, sentinel_of
from wavefocus.acquisition.setup import Setup
from wavefocus.calibration.numerics import evenly_spread, one_blas_thread
from wavefocus.config.messages.campaign import State, Subscriber
from wavefocus.config.run import DriftLimits
from wavefocus.rendering.arrays import Int64Array
from wavefocus.rendering.field.metrics import level_db
from wavefocus.rendering.number_text import number
from wavefocus.rendering.verify.field_pair import BandLimit
from wavefocus.rendering.verify.results import Figure, Sentinel, SentinelDrift, judged
from wavefocus.rendering.verify.scan import Scan
from wavefocus.storage.bank.ledger import Status

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource
    from wavefocus.storage.bank.reading import Bank
    from wavefocus.storage.drive_file import Drive
    from wavefocus.storage.field_file import Field


def measure_sentinel(plan: Plan, setup: Setup, bank: Bank, publish: Subscriber = lambda event: None) -> Sentinel | str:
    """Measure the bank's sentinel position again, as a campaign does.

    plan: What was played when the bank was measured.
    publish: Receives the events of faults and of waiting for a lost instrument.

    Returns why in words where it gives no usable record any more, empty where the bank has no valid position.
    Raises InstrumentError: an instrument failed for good.
    """
    position = sentinel_of(np.asarray(bank.status))
    if position is None:
        return ""
    attempts, moved_mm, peak_v = (bank.quality[name][position] for name in ("attempts", "moved_mm", "peak_v"))
    attempt = as_measured(position, int(attempts), float(moved_mm), peak_v, setup, plan)
    session = Session(setup.clock, publish, StopRequest())
    session.enter(State.RUNNING, f"sentinel position {position} to measure")
    with one_blas_thread():
        result = Station(plan, setup, session).measure(attempt, "sentinel", says_nothing)
    if result.estimate is None or says_nothing(result):
        return result.judgement.reason
    return Sentinel(position, result.estimate.green, result.estimate.snr_db)


def drift_of(sentinel: Sentinel, bank: GreenSource, limits: DriftLimits) -> SentinelDrift:
    """How the sentinel position differs from the bank: as a level and as a delay."""
    then, rate_hz = np.asarray(bank.green(sentinel.position), np.float32), bank.sample_rate_hz
    figures = compare_sentinel(then, sentinel.green, band_hz=bank.band_hz, sample_rate_hz=rate_hz)
    return SentinelDrift(
        sentinel.position,
        float(figures.level_db),
        1e6 * figures.delay_samples / rate_hz,
        figures.correlation,
        figures.verdict(limits),
    )


def drift_figures(drift: SentinelDrift) -> tuple[Figure, ...]:
    """Lines of the table of figures; none has a limit, for the run's own limits give the verdict."""
    again = f"position {drift.position}, measured again before the scan, against its rows in the bank: "
    return (
        Figure("sentinel level", "dB", again + "energy over all actuators", difference=drift.level_db,
               value=drift.level_db),
        Figure("sentinel delay", "µs", again + "lag of the largest cross-correlation, above 0 where it is later",
               difference=drift.delay_us, value=drift.delay_us),
        Figure("sentinel correlation", "", again + "the largest cross-correlation", value=drift.correlation),
    )  # fmt: skip


def drift_sentence(drift: SentinelDrift) -> str:
    """The drift in words."""
    state = {"steady": "steady", "warn": "changed", "stop": "changed much"}[drift.verdict]
    return (
        f"Sentinel position {drift.position} since the bank was measured: {state}; level"
        f" {number(drift.level_db, 'dB')}, delay {number(drift.delay_us, 'µs')}, correlation"
        f" {drift.correlation:.4f}. The prediction is not corrected for it."
    )


QUIETER_DB = 12.0
_FACTOR = 10.0 ** (QUIETER_DB / 20.0)
MAX_POSITIONS = 24
"""Positions of the quieter scan; half of them are foci, where there are so many."""


def quieter(drive: Drive) -> Drive:
    """The drive, 12 dB quieter."""
    return dataclasses.replace(drive, drive_v=drive.drive_v / _FACTOR)


def linearity_rows(drive: Drive, rows: Int64Array) -> tuple[int, ...]:
    """Bank rows of the scanned ones that the quieter scan visits: some foci, and others spread evenly."""
    foci = np.intersect1d(drive.focus_position, rows)
    foci = foci[evenly_spread(len(foci), MAX_POSITIONS // 2)]
    others = np.setdiff1d(rows, foci)
    others = others[evenly_spread(len(others), MAX_POSITIONS - len(foci))]
    return tuple(np.union1d(foci, others).tolist())


def linearity(
    prediction: Field, loud: Scan, quiet: Scan, band_hz: tuple[float, float] | None, error_limit: float
) -> tuple[tuple[Figure, ...], float | None]:
    """Compare a scan with one of the same scene 12 dB quieter, at some of its positions, scaled to one level.

    prediction, loud: Prediction and scan; quiet: The scan of `quieter`.
    band_hz: Band to which all are limited.
    error_limit: The largest difference that passes.

    Returns difference and compression as figures, none where no position has a sound record in both; and the share of
    the squared difference of scan and prediction that is not there when the scene is played quieter, 0 to 1, noise
    taken off both, None where there is nothing but noise.
    """
    sound = [scanned.position_index[scanned.status == Status.VALID] for scanned in (loud, quiet)]
    rows = np.intersect1d(np.intersect1d(*sound), prediction.position_index)
    if not rows.size:
        return (), None
    samples = loud.field.shape[1]
    band = BandLimit(samples, loud.sample_rate_hz, band_hz)
    in_prediction = [int(np.flatnonzero(prediction.position_index == row)[0]) for row in rows]
    predicted = band.spectrum(prediction.field[in_prediction].astype(np.float32))
    fields, noise, missed = [], [], []
    for played, factor in ((loud, 1.0), (quiet, _FACTOR)):
        at = np.searchsorted(played.position_index, rows)
        spectrum = band.spectrum(factor * played.field[at])
        fields.append(band.signals(spectrum).astype(np.float64))
        noise.append(float(np.nansum((factor * played.noise_rms[at]) ** 2)) * samples * band.white_share)
        missed.append(float(np.sum(band.signals(spectrum - predicted).astype(np.float64) ** 2)) - noise[-1])
    energy, difference = float(np.sum(fields[0] ** 2)), float(np.sum((fields[0] - fields[1]) ** 2))
    beyond = 100.0 * math.sqrt(max(difference - sum(noise), 0.0) / energy) if energy > 0.0 else math.inf
    gain = float(np.sum(fields[0] * fields[1])) / max(float(np.sum(fields[1] ** 2)) - noise[1], 1e-300)
    compressed_db = -level_db(max(gain, 0.0)) + 0.0
    what = (
        f" of the scan and of the same scene {QUIETER_DB:g} dB quieter, scaled to one level, at {len(rows)} positions"
    )
    apart = f"norm of the difference{what}, without the noise's part, over the norm of the scan"
    quieter_by = f"by how much the scan is quieter than in proportion, by the best gain{what}"
    figures = (
        judged("linearity", "%", apart, beyond, "at most", 100.0 * error_limit, difference=beyond),
        Figure("compression", "dB", quieter_by, difference=compressed_db, value=compressed_db),
    )
    return figures, float(np.clip(1.0 - missed[1] / missed[0], 0.0, 1.0)) if missed[0] > 0.0 else None
