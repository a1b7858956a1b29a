"""The estimator for a file of raw recordings: the campaign's own where the file tells it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from acquisition.engine.measuring import position_estimator
from acquisition.schedule.plan import Plan
from calibration.estimator.position import Channels, PositionEstimator
from calibration.estimator.raw_estimation import estimator_of
from storage.errors import InputError
from storage.raw.header import RawHeader
from storage.raw.reading import RawFile
from wavefocus.campaign.blueprint import blueprint_of
from wavefocus.configuration import configuration_from_json


def own_plan(header: RawHeader, raw: Path) -> Plan | None:
    """The plan that the recordings were made by; None where the file does not carry one that this version knows."""
    if not (header.rig_json and header.run_json):
        return None
    try:
        plan = blueprint_of(
            configuration_from_json(header.rig_json, header.run_json, header.position_mm, str(raw))
        ).plan
    except InputError:
        return None
    return plan if plan.sha256 == header.plan_sha256 else None


def estimator_for(
    recordings: RawFile, plan: Plan | None, tell: Callable[[str], None] = lambda line: None
) -> PositionEstimator:
    """The campaign's own estimator, which gives its bank again; else what the reference channels tell."""
    if plan is None:
        return estimator_of(recordings, tell)
    header = recordings.header
    channels = Channels(header.reference_gain, header.response_per_volt, header.inter_channel_delay_s)
    return position_estimator(plan, channels)
