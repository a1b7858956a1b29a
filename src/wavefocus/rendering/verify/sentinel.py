"""The bank's sentinel position, measured again with a scan: what has changed since the bank was measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from wavefocus.acquisition.attempt import Attempt
from wavefocus.acquisition.drift_watch import says_nothing
from wavefocus.acquisition.engine.session import Session, StopRequest
from wavefocus.acquisition.engine.station import Station
from wavefocus.acquisition.limits import compare_sentinel
from wavefocus.acquisition.plan import Plan, sentinel_of
from wavefocus.acquisition.setup import Setup
from wavefocus.calibration.numerics import one_blas_thread
from wavefocus.config.messages.campaign import State, Subscriber
from wavefocus.config.run import DriftLimits
from wavefocus.rendering.number_text import number
from wavefocus.rendering.verify.results import Figure, Sentinel, SentinelDrift
from wavefocus.rendering.verify.symptoms import wave_speed

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource


def measure_sentinel(
    plan: Plan, setup: Setup, bank: GreenSource, publish: Subscriber = lambda event: None
) -> Sentinel | None:
    """Measure the bank's sentinel position again, as a campaign does.

    plan: What was played when the bank was measured.
    publish: Receives the events of faults and of waiting for a lost instrument.

    Returns None where the bank has no valid position, or where it gives no usable record any more.
    Raises InstrumentError: an instrument failed for good.
    """
    position = sentinel_of(plan, np.asarray(bank.status))
    if position is None:
        return None
    session = Session(setup.instruments.clock, publish, StopRequest())
    session.enter(State.RUNNING, f"sentinel position {position} to measure")
    with one_blas_thread():
        result = Station(plan, setup, session).measure(Attempt(position, 1, 1), "sentinel", says_nothing)
    if result.estimate is None:
        return None
    return Sentinel(position, result.estimate.green, result.estimate.snr_db)


def drift_of(sentinel: Sentinel, bank: GreenSource, limits: DriftLimits) -> SentinelDrift:
    """How the sentinel position differs from the bank: as a level, as a delay, and as a wave speed."""
    then, rate_hz = np.asarray(bank.green(sentinel.position), np.float32), bank.sample_rate_hz
    figures = compare_sentinel(then, sentinel.green, band_hz=bank.band_hz, sample_rate_hz=rate_hz)
    return SentinelDrift(
        sentinel.position,
        float(figures.level_db),
        1e6 * figures.delay_samples / rate_hz,
        figures.correlation,
        wave_speed(sentinel, bank),
        figures.verdict(limits),
    )


def drift_figures(drift: SentinelDrift) -> tuple[Figure, ...]:
    """Lines of the table of figures; none has a limit, for the run's own limits give the verdict."""
    again = f"position {drift.position}, measured again before the scan, against its rows in the bank: "
    speed = drift.speed_percent
    return (
        Figure("sentinel level", "dB", again + "energy over all actuators", difference=drift.level_db,
               value=drift.level_db),
        Figure("sentinel delay", "µs", again + "lag of the largest cross-correlation, above 0 where it is later",
               difference=drift.delay_us, value=drift.delay_us),
        Figure("sentinel wave speed", "%", again + "change of speed, where it explains most of the difference",
               difference=speed, value=speed),
        Figure("sentinel correlation", "", again + "the largest cross-correlation", value=drift.correlation),
    )  # fmt: skip


def drift_sentence(drift: SentinelDrift) -> str:
    """The drift in words."""
    speed = "" if drift.speed_percent is None else f", wave speed {number(drift.speed_percent, '%')}"
    state = {"steady": "steady", "warn": "changed", "stop": "changed much"}[drift.verdict]
    return (
        f"Sentinel position {drift.position} since the bank was measured: {state}; level"
        f" {number(drift.level_db, 'dB')}, delay {number(drift.delay_us, 'µs')}{speed}, correlation"
        f" {drift.correlation:.4f}. The prediction is not corrected for it."
    )
