"""Sentences of the Campaign tab about positions, rates and times."""

from __future__ import annotations

import math
from datetime import UTC, datetime

import pytest

from wavefocus.campaign.status import CampaignStatus
from wavefocus.commands.status import _pace_sentences
from wavefocus.config.messages.campaign import Logged, PositionCommitted, Progress, State
from wavefocus.gui.campaign.model import Extra, ShownState, line_of
from wavefocus.gui.campaign.panels import pace_text
from wavefocus.storage.bank.ledger import VALID

POOR = 4


def committed(status: int, snr_db: float, residual_db: float, reason: str = "") -> Logged:
    event = PositionCommitted(0.0, 7, status, 2, snr_db, residual_db, 0.0, 0.0, reason=reason)
    return Logged(datetime.now(UTC), event)


def test_given_a_position_without_figures_then_its_reason_is_said_and_no_nan() -> None:
    logged = committed(POOR, math.nan, math.nan, "no sweep found in record 3")
    line = line_of(logged)
    assert line is not None
    assert line.text.endswith(": no sweep found in record 3")
    assert "nan" not in line.text
    good = line_of(committed(VALID, 41.25, -52.0))
    assert good is not None
    assert "41.2 dB" in good.text
    assert "-52.0 dB" in good.text


def paced(per_hour: float, left_s: float) -> CampaignStatus:
    return CampaignStatus().after(Logged(datetime.now(UTC), Progress(0.0, 3, 10, 1.0, left_s, left_s, per_hour)))


@pytest.mark.parametrize("state", [*State, *Extra])
def test_a_state_then_a_remaining_time_is_shown_only_while_positions_are_measured(state: State | Extra) -> None:
    text = pace_text(paced(120.0, 4.0), going_on=ShownState(state).going_on)
    assert ("left" in text) is (state is State.RUNNING)
    assert text.startswith("120 positions an hour")


def test_given_a_rate_that_is_not_known_then_nothing_is_said_about_it() -> None:
    assert pace_text(paced(math.nan, math.nan), going_on=True) == ""


def test_given_the_last_position_then_the_rate_stands_without_an_empty_part() -> None:
    progress = Progress(
        time_s=1.0, done=9, total=9, elapsed_s=1.0, remaining_s=0.0, wall_remaining_s=0.0, positions_per_hour=57_400.0
    )
    (line,) = _pace_sentences(CampaignStatus(State.RUNNING, progress=progress, progress_at=datetime.now(UTC)), 0)
    assert line.startswith("57400 positions an hour (last position ")
