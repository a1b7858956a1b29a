"""Before a staggered campaign: one position measured one actuator after the other and as asked for, and compared."""

import math
from dataclasses import replace

import numpy as np

from wavefocus.acquisition.attempt import Attempt, AttemptResult
from wavefocus.acquisition.engine.session import Session, StopRequest
from wavefocus.acquisition.engine.station import Station
from wavefocus.acquisition.judgement import in_band
from wavefocus.acquisition.plan import Plan, schedule_name
from wavefocus.acquisition.setup import Setup
from wavefocus.acquisition.wording import hours
from wavefocus.calibration.estimator.estimate import Estimate
from wavefocus.calibration.estimator.noise_error import noise_error_db
from wavefocus.config.messages.campaign import ScheduleSettled, Subscriber
from wavefocus.storage.errors import InputError


def check_position(plan: Plan) -> int:
    """The position nearest to the middle of the grid."""
    middle = (plan.position_mm.min(axis=0) + plan.position_mm.max(axis=0)) / 2
    return int(np.argmin(np.hypot(*(plan.position_mm - middle).T)))


def compare_schedules(plan: Plan, setup: Setup, publish: Subscriber = lambda event: None) -> ScheduleSettled:
    """Measure one position by a staggered plan and one actuator after the other.

    Errors are medians over the actuators: relative L2 difference in band of the rows, and what the noise of sequential
    capture explains of it.

    publish: Receives every passing fault, and what is done about it, as in a campaign.

    Raises InputError: sequential sweeps show responses longer than the taps, or no attempt has a usable reference.
    InstrumentError: an instrument failed for good.
    """
    clock, position, sweep = setup.instruments.clock, check_position(plan), plan.excitation
    began_s, session = clock.now_s(), Session(clock, publish, StopRequest())
    plans = plan, replace(plan, staggered=None)
    asked, plain = (
        _measured(Station(one, setup, session), Attempt(position, number, 1)) for number, one in enumerate(plans, 1)
    )
    rows, others = (in_band(one.green, sweep.sample_rate_hz, sweep.band_hz) for one in (plain, asked))
    apart = np.linalg.norm(others - rows, axis=1) / np.maximum(np.linalg.norm(rows, axis=1), 1e-300)
    response_s, period_s = (samples / sweep.sample_rate_hz for samples in (plan.taps, sweep.period_samples))
    noise_db = noise_error_db(plain.snr_db, band_hz=sweep.band_hz, response_s=response_s, period_s=period_s)
    error_db = 20 * math.log10(max(float(np.median(apart)), 1e-15)), float(np.median(noise_db))
    looks = plan.looks(*range(plan.positions))
    names, seconds = zip(*((schedule_name(one), looks * one.position_s(setup)) for one in plans), strict=True)
    sentence = (
        f"{names[0]} differs from {names[1]} by {error_db[0]:.1f} dB at position {position}, where noise explains "
        f"{error_db[1]:.1f} dB; the campaign takes {hours(seconds[0])} instead of {hours(seconds[1])}"
    )
    candidates = tuple(
        {"name": name, "error_db": error, "campaign_s": campaign_s}
        for name, error, campaign_s in zip(names, error_db, seconds, strict=True)
    )
    return ScheduleSettled(clock.now_s() - began_s, position, names[0], sentence, seconds[0] / 3600, candidates)


def _measured(station: Station, attempt: Attempt) -> Estimate:
    result = station.measure(attempt, "trial", _is_spoilt)
    if result.estimate is None:
        raise InputError(f"the position that is measured by both schedules failed: {result.judgement.reason}")
    for defect in result.judgement.defects:
        if defect.name == "tail":
            raise InputError(defect.sentence)
    return result.estimate


def _is_spoilt(result: AttemptResult) -> bool:
    return result.estimate is None or any(any(recording.over_range) for recording in result.recordings)
