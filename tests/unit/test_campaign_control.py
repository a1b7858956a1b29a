"""Heartbeat, orders and status: how processes learn of one another's campaign."""

import threading
import time
from datetime import UTC, datetime, timedelta

import pytest

from wavefocus.acquisition.engine.session import StopRequest
from wavefocus.campaign.control import (
    CampaignControl,
    give_order,
    heartbeat_path,
    orders_path,
    read_heartbeat,
    take_order,
    withdraw,
)
from wavefocus.campaign.sidecar_files import log_path
from wavefocus.campaign.status import Heartbeat, Recovering, campaign_status
from wavefocus.config.messages.campaign import (
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


def _until(condition, seconds=30.0):
    until_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until_s
        time.sleep(0.005)


@pytest.mark.parametrize(
    ("ahead_s", "silent"), [(-1.0, False), (-40.0, True), (0.5, False), (40.0, True), (3600.0, True), (-3e8, True)]
)
def test_a_clock_that_was_set_back_then_an_old_heartbeat_is_silent_all_the_same(ahead_s, silent):
    now = datetime.now(UTC)
    assert Heartbeat(now + timedelta(seconds=ahead_s), 12, "here").is_silent(now) is silent


@pytest.mark.parametrize(
    "text", ["", "{", "[1]", '{"at": 1}', '{"at": "2026-01-01T00:00:00", "pid": 1, "host": "h"}', '{"at": "x"}',
             '{"at": "2026-01-01T00:00:00+00:00", "pid": 1, "host": "h", "state": "dancing"}']
)  # fmt: skip
def test_given_a_heartbeat_that_is_none_then_there_is_none(tmp_path, text):
    heartbeat_path(tmp_path / "plate.h5").write_text(text, encoding="utf-8")
    assert read_heartbeat(tmp_path / "plate.h5") is None


def test_given_an_order_then_it_is_taken_once(tmp_path):
    bank = tmp_path / "plate.h5"
    assert take_order(bank) is None
    order = give_order(bank, "pause")
    assert take_order(bank) == order
    assert take_order(bank) is None
    assert list(tmp_path.iterdir()) == []


def test_two_orders_then_the_later_one_counts_and_the_earlier_cannot_withdraw_it(tmp_path):
    bank = tmp_path / "plate.h5"
    first, second = give_order(bank, "pause"), give_order(bank, "stop")
    withdraw(bank, first)
    assert take_order(bank) == second
    withdraw(bank, give_order(bank, "stop"))
    assert take_order(bank) is None


@pytest.mark.parametrize("text", ["", "{", '{"order": "explode", "number": "1"}', '{"order": "stop"}', "[]"])
def test_given_something_that_is_no_order_then_it_is_taken_away_and_nothing_happens(tmp_path, text):
    bank = tmp_path / "plate.h5"
    orders_path(bank).write_text(text, encoding="utf-8")
    assert take_order(bank) is None
    assert not orders_path(bank).exists()


def test_given_orders_while_it_attends_then_they_are_obeyed_and_acknowledged(tmp_path):
    bank, stop = tmp_path / "plate.h5", StopRequest()
    give_order(bank, "stop")  # left over from a session long ago
    with CampaignControl(bank, stop):
        for word, obeyed in (
            ("pause", lambda: stop.pause_requested),
            ("go-on", lambda: not stop.pause_requested),
            ("stop", lambda: stop.requested),
        ):
            order = give_order(bank, word)
            _until(lambda order=order: (beat := read_heartbeat(bank)) is not None and beat.order == order.number)
            assert obeyed()
    assert not orders_path(bank).exists()


def test_a_heartbeat_that_cannot_be_written_is_told_once_and_orders_work(tmp_path, capsys):
    bank, stop = tmp_path / "plate.h5", StopRequest()
    heartbeat_path(bank).mkdir()
    with CampaignControl(bank, stop) as control:
        for number in range(5):
            control(StateChanged(float(number), State.RUNNING, "again"))
            time.sleep(0.02)
        give_order(bank, "stop")
        _until(lambda: stop.requested)
    assert capsys.readouterr().err.count("heartbeat of") == 1


def test_given_an_order_laid_while_another_is_taken_then_it_is_not_lost(tmp_path):
    bank = tmp_path / "plate.h5"
    for _ in range(50):
        taken = []
        taker = threading.Thread(target=lambda taken=taken: taken.append(take_order(bank)))
        give_order(bank, "pause")
        taker.start()
        last = give_order(bank, "stop")
        taker.join()
        taken.append(take_order(bank))
        assert last in taken
        assert list(tmp_path.iterdir()) == []


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


def after(bank, *events, owner=OWNER, beat=None):
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
