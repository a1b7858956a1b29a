"""Status of a campaign by what its log says."""

from datetime import UTC, datetime
from pathlib import Path

import pytest

from wavefocus.campaign.sidecar_files import log_path
from wavefocus.campaign.status import CampaignStatus, Heartbeat, Recovering, campaign_status
from wavefocus.config.messages.campaign import (
    Event,
    Fault,
    PositionKept,
    PositionStarted,
    Progress,
    ReconnectTried,
    RecordTaken,
    SessionEnded,
    SessionStarted,
    State,
    StateChanged,
    event_line,
)
from wavefocus.storage.ledger.owner import Owner

OWNER = Owner("here", 7)
STARTED = SessionStarted(0.0, "plate.h5", 9, 3, 2, 7, 70.0, ())
RUNNING = StateChanged(0.0, State.RUNNING, "7 positions to do")
FAULT = Fault(1.0, "virtual mirror", "moving", "it is gone", "plug it in", 5, 1, True)
LOST = StateChanged(1.0, State.RECOVERING, "virtual mirror: it is gone")
TRIED = ReconnectTried(2.0, "mirror", "virtual mirror", 3, False, "no answer", 5.0, 60.0)
WAITS = Recovering("virtual mirror", 3, "no answer", 5.0, 60.0)
PROGRESS = Progress(2.0, 3, 9, 2.0, 120.0, 60.0, 100.0)
RECORD = RecordTaken(2.0, 5, 1, 2, 3)
KEPT = PositionKept(2.0, 4, 1, "no better")


def after(bank: Path, *events: Event, owner: Owner | None = OWNER, beat: Heartbeat | None = None) -> CampaignStatus:
    log_path(bank).write_text("".join(map(event_line, events)), encoding="utf-8")
    return campaign_status(bank, owner, beat)


@pytest.mark.parametrize(
    ("events", "state", "recovering"),
    [
        ([], State.IDLE, None),
        ([STARTED], State.IDLE, None),
        ([STARTED, RUNNING], State.RUNNING, None),
        ([STARTED, RUNNING, FAULT, LOST], State.RECOVERING, Recovering("virtual mirror")),
        ([STARTED, RUNNING, LOST], State.RECOVERING, Recovering()),
        ([STARTED, RUNNING, FAULT, LOST, TRIED], State.RECOVERING, WAITS),
        ([STARTED, RUNNING, FAULT, LOST, TRIED, RUNNING], State.RUNNING, None),
        ([STARTED, RUNNING, StateChanged(3.0, State.FINISHED, "done")], State.IDLE, None),
        ([STARTED, RUNNING, SessionEnded(3.0, State.FINISHED, 9, 9, {})], State.IDLE, None),
        ([STARTED, RUNNING, STARTED], State.IDLE, None),
    ],
)  # fmt: skip
def test_given_events_then_the_state_is_that_of_the_latest_session(tmp_path, events, state, recovering):
    status = after(tmp_path / "plate.h5", *events)
    assert (status.state, status.recovering) == (state, recovering)
    assert (status.since is None) == (status.reason == "") == (state is State.IDLE)


def test_given_a_session_under_way_then_progress_record_and_what_is_kept_are_known(tmp_path):
    bank = tmp_path / "plate.h5"
    status = after(bank, STARTED, RUNNING, KEPT, PROGRESS, PositionStarted(2.0, 5, 1, 0.0, 0.0), RECORD)
    assert (status.progress, status.record, status.kept) == (PROGRESS, RECORD, {4: "no better"})
    assert status.planned_s == 70.0
    assert after(bank, STARTED, RECORD, PositionStarted(3.0, 6, 1, 0.0, 0.0)).record is None
    fresh = after(bank, STARTED, KEPT, PROGRESS, RECORD, STARTED)
    assert (fresh.progress, fresh.record, fresh.kept) == (None, None, {})


def test_given_no_owner_then_nothing_goes_on_and_what_is_kept_is_named(tmp_path):
    status = after(tmp_path / "plate.h5", STARTED, RUNNING, KEPT, PROGRESS, owner=None)
    assert (status.state, status.progress, status.kept) == (State.IDLE, None, {4: "no better"})
    assert status.last_event_at is not None


@pytest.mark.parametrize(("pid", "state"), [(7, State.PAUSED), (8, State.IDLE)])
def test_given_a_log_that_ended_then_the_owners_heartbeat_says_the_state(tmp_path, pid, state):
    beat = Heartbeat(datetime.now(UTC), pid, "here", State.PAUSED, "as asked")
    assert after(tmp_path / "plate.h5", beat=beat).state is state
