"""How processes learn of one another's campaign: events, their log and sentences, heartbeat, orders and status."""

import json
import math
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from tests.system.lines import wait_until
from wavefocus.acquisition.engine.session import Session, StopRequest
from wavefocus.acquisition.event_wording import sentence
from wavefocus.campaign import control
from wavefocus.campaign.sidecar_files import last_events, log_path
from wavefocus.campaign.status import CampaignView, Heartbeat, campaign_status
from wavefocus.commands.capture import resume
from wavefocus.commands.status import is_paused, recovery
from wavefocus.config.messages import campaign as told
from wavefocus.config.messages import tag
from wavefocus.config.messages.campaign import State
from wavefocus.gui.campaign.model import line_of
from wavefocus.mocks.virtual import VirtualClock
from wavefocus.options import SessionOptions
from wavefocus.storage.durable import PositionedFile
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.owner import Owner, take_ownership, write_owner


@pytest.fixture
def bank(tmp_path):
    """The name of a bank that is not there; only what lies beside it is."""
    return tmp_path / "plate.h5"


def test_given_an_event_then_its_line_names_its_kind_and_fields_and_is_read_again():
    for event, fields in (
        (told.PositionCommitted(1.5, 7, 1, 2, 41.0, -38.0, 30.0, 120.25, defects=("clipped",)), {"position": 7}),
        (told.PositionCommitted(1.5, 7, 8, 3, math.nan, math.inf, 0.0, 0.0), {"snr_db": None, "residual_db": None}),
        (told.SessionEnded(2.0, State.STOPPED, 3, 6, {"valid": 3}), {"state": "stopped", "counts": {"valid": 3}}),
    ):
        record = json.loads(told.event_line(event))
        assert record | fields | {"event": tag(event)} == record
        logged = told.read_event(told.event_line(event).encode())
        assert logged is not None
        assert told.event_line(logged.event).partition(", ")[2] == told.event_line(event).partition(", ")[2]


@pytest.mark.parametrize("line", ['"event": "prog', '"event": "of_a_later_version"}', '"event": "position_kept"}',
                                  '"event": "state_changed", "state": "dancing", "reason": ""}'])  # fmt: skip
def test_given_a_line_that_is_no_event_then_it_is_passed_over(line):
    for text in ('{"at": "2026-01-01T00:00:00+00:00", ' + line, "{" + line, "[1, 2]", ""):
        assert told.read_event(text.encode()) is None


@pytest.mark.parametrize(("events", "padding"), [(0, 0), (1500, 60), (5, 70_000)])
def test_given_a_log_then_its_events_come_newest_first_and_none_is_missing(bank, events, padding):
    kept = [told.PositionKept(0.0, number, 1, "x" * padding) for number in range(events)]
    if kept:
        torn = '[1, 2]\n\n{"event": "prog'
        log_path(bank).write_text("".join(map(told.event_line, kept)) + torn, encoding="utf-8")
    assert [logged.event for logged in last_events(bank)] == kept[::-1]


# Events that a person at the terminal sees, and those that only the window lists.
AT_THE_TERMINAL: tuple[told.Event, ...] = (
    told.SessionStarted(0.0, "plate.h5", 6, 3, 2, 4, 60.0, ()),
    told.StateChanged(0.0, State.PAUSED, "as asked"),
    told.PositionCommitted(0.0, 7, 4, 2, 12.0, -9.0, 0.0, 0.0, reason="it differs", defects=("neighbour level",)),
    told.PositionRepeated(0.0, 7, 1, "a burst", (), 2.0, (0.3, 0.4)),
    told.PositionKept(0.0, 7, 2, "no better"),
    told.PassStarted(0.0, (3, 4, 5)),
    told.Fault(0.0, "mirror", "moving", "it is gone", "plug it in", 5, 1, True),
    told.ReconnectTried(0.0, "mirror", "mirror", 2, False, "no answer", 5.0, 60.0),
    told.CrosstalkMeasured(0.0, -30.0, 0.0, 0.03, 9.0, True, (1, 2), "a cable leaks"),
    told.Drift(0.0, 0, -0.7, 0.1, 0.99, "warn", "run", "the level changed", ()),
    told.ConditionsSeen(0.0, {"temperature": 30.0}, False, "temperature is 30"),
    told.SessionEnded(0.0, State.FINISHED, 6, 6, {"valid": 6}),
)
IN_THE_WINDOW: tuple[told.Event, ...] = (
    told.ScheduleSettled(0.0, 3, "staggered", "it is quicker", 2.0, ()),
    told.PositionStarted(0.0, 7, 2, 4.0, 0.0),
    told.PositionCommitted(0.0, 7, 1, 1, 41.25, math.nan, 0.0, 0.0),
    told.CrosstalkMeasured(0.0, -90.0, 0.0, 0.0, 1.0, False),
    told.ConditionsSeen(0.0, {}, True, "all is back"),
)
SHOWN_OTHERWISE = {told.Progress, told.RecordTaken}


def test_each_kind_of_event_has_a_sentence_that_terminal_and_window_show(capsys):
    kinds = {type(event) for event in (*AT_THE_TERMINAL, *IN_THE_WINDOW)} | SHOWN_OTHERWISE
    assert set(told.Event.__subclasses__()) == kinds
    for event in (*AT_THE_TERMINAL, *IN_THE_WINDOW):
        text = sentence(event)
        assert text != tag(event)
        assert "nan" not in text
        line = line_of(told.Logged(datetime.now(UTC), event))
        assert line is not None
        assert line.text == text
        CampaignView(lambda done, total, note="": None)(event)
        shown = capsys.readouterr().err
        assert shown.startswith(text) if event in AT_THE_TERMINAL else shown == ""


def test_a_subscriber_of_a_session_that_fails_is_reported_once_and_told_the_rest(caplog):
    heard = []

    def fail(event):
        heard.append(event)
        raise ValueError("I/O operation on closed file")

    session = Session(VirtualClock(), fail, StopRequest())
    session.enter(State.RUNNING, "2 positions to do")
    session.enter(State.FINISHED, "done")
    assert [event.state for event in heard] == [State.RUNNING, State.FINISHED]
    assert ["closed file" in record.message for record in caplog.records] == [True]


def test_given_the_table_of_states_then_the_page_about_states_has_the_same_one():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "states.md").read_text(encoding="utf-8")
    rows = {}
    for line in page.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 3 and cells[0].strip("`") in set(State):
            words = [word.strip().strip("`") for word in cells[2].split(",")]
            rows[State(cells[0].strip("`"))] = {State(word) for word in words if word in set(State)}
    assert rows == {state: set(follows) for state, follows in Session.FOLLOWS.items()}


@pytest.mark.parametrize(
    ("ahead_s", "silent"), [(-1.0, False), (-40.0, True), (0.5, False), (40.0, True), (3600.0, True), (-3e8, True)]
)
def test_a_clock_that_was_set_back_then_an_old_heartbeat_is_silent_all_the_same(ahead_s, silent):
    assert Heartbeat(datetime.now(UTC) + timedelta(seconds=ahead_s), 12, "here").is_silent() is silent


@pytest.mark.parametrize(
    "text", ["", "{", "[1]", '{"at": 1}', '{"at": "2026-01-01T00:00:00", "pid": 1, "host": "h"}', '{"at": "x"}',
             '{"at": "2026-01-01T00:00:00+00:00", "pid": 1, "host": "h", "state": "dancing"}',
             '{"order": "explode", "number": "1"}', '{"order": "stop"}']
)  # fmt: skip
def test_what_is_no_heartbeat_or_no_order_is_none_and_such_an_order_is_taken_away(bank, text):
    for path in (control.heartbeat_path(bank), control.orders_path(bank)):
        path.write_text(text, encoding="utf-8")
    assert control.read_heartbeat(bank) is None
    assert control.take_order(bank) is None
    assert not control.orders_path(bank).exists()


def test_orders_are_taken_once_and_the_later_one_counts(bank):
    assert control.take_order(bank) is None
    first, second = control.give_order(bank, "pause"), control.give_order(bank, "stop")
    control.withdraw(bank, first)  # the later one stays
    assert control.take_order(bank) == second
    assert control.take_order(bank) is None
    control.withdraw(bank, control.give_order(bank, "stop"))
    assert control.take_order(bank) is None
    assert list(bank.parent.iterdir()) == []


def test_a_heartbeat_that_cannot_be_written_is_told_once_and_orders_work(bank, capsys):
    stop = StopRequest()
    control.heartbeat_path(bank).mkdir()
    control.give_order(bank, "stop")  # left over from a session long ago
    with control.CampaignControl(bank, stop) as attending:
        for number in range(5):
            attending(told.StateChanged(float(number), State.RUNNING, "again"))
            time.sleep(0.02)
        assert not stop.requested
        control.give_order(bank, "stop")
        wait_until(lambda: stop.requested, "the order is taken")
    assert capsys.readouterr().err.count("heartbeat of") == 1


def test_given_an_order_laid_while_another_is_taken_then_it_is_not_lost(bank):
    for _ in range(50):
        taken = []
        taker = threading.Thread(target=lambda taken=taken: taken.append(control.take_order(bank)))
        control.give_order(bank, "pause")
        taker.start()
        last = control.give_order(bank, "stop")
        taker.join()
        taken.append(control.take_order(bank))
        assert last in taken
        assert list(bank.parent.iterdir()) == []


OWNER = Owner("here", 7)
STARTED = told.SessionStarted(0.0, "plate.h5", 9, 3, 2, 7, 70.0, ())
RUNNING = told.StateChanged(0.0, State.RUNNING, "7 positions to do")
FAULT = told.Fault(1.0, "virtual mirror", "moving", "it is gone", "plug it in", 5, 1, True)
LOST = told.StateChanged(1.0, State.RECOVERING, "virtual mirror: it is gone")
TRIED = told.ReconnectTried(2.0, "mirror", "virtual mirror", 3, False, "no answer", 5.0, 60.0)
TRIES = ("instrument", "tries", "outcome", "next_try_s", "gives_up_s")
PROGRESS = told.Progress(2.0, 3, 9, 2.0, 120.0, 60.0, 100.0)
RECORD = told.RecordTaken(2.0, 5, 1, 2, 3)
KEPT = told.PositionKept(2.0, 4, 1, "no better")


def after(bank, *events, owner=OWNER, beat=None):
    log_path(bank).write_text("".join(map(told.event_line, events)), encoding="utf-8")
    return campaign_status(bank, owner, beat)


@pytest.mark.parametrize(
    ("events", "state", "recovering"),
    [
        ([], State.IDLE, None),
        ([STARTED], State.IDLE, None),
        ([STARTED, RUNNING], State.RUNNING, None),
        ([STARTED, RUNNING, FAULT, LOST], State.RECOVERING, ("virtual mirror", None, None, None, None)),
        ([STARTED, RUNNING, LOST], State.RECOVERING, (None,) * 5),
        ([STARTED, RUNNING, FAULT, LOST, TRIED], State.RECOVERING, ("virtual mirror", 3, "no answer", 5.0, 60.0)),
        ([STARTED, RUNNING, FAULT, LOST, TRIED, RUNNING], State.RUNNING, None),
        ([STARTED, RUNNING, told.StateChanged(3.0, State.FINISHED, "done")], State.IDLE, None),
        ([STARTED, RUNNING, told.SessionEnded(3.0, State.FINISHED, 9, 9, {})], State.IDLE, None),
        ([STARTED, RUNNING, STARTED], State.IDLE, None),
    ],
)
def test_given_events_then_the_state_is_that_of_the_latest_session(bank, events, state, recovering):
    status = after(bank, *events)
    assert (status.state, recovery(status)) == (state, recovering and dict(zip(TRIES, recovering, strict=True)))
    assert (status.since is None) == (status.reason == "") == (state is State.IDLE)


def test_given_a_pause_while_recovering_then_resume_without_options_takes_it_back(bank):
    bank.touch()
    with PositionedFile(bank) as file, control.CampaignControl(bank, StopRequest()):
        take_ownership(bank, file, "bank")
        write_owner(bank)
        after(bank, STARTED, RUNNING, FAULT, LOST)
        control.give_order(bank, "pause")
        wait_until(lambda: is_paused(bank), "the pause is taken")
        with pytest.raises(InputError, match="is paused and goes on with the rig that it has open"):
            resume(bank, options=SessionOptions(rig_file=bank))
        control.give_order(bank, "go-on")
        wait_until(lambda: not is_paused(bank), "the pause is taken back")


def test_given_a_session_under_way_then_progress_record_and_what_is_kept_are_known(bank):
    status = after(bank, STARTED, RUNNING, KEPT, PROGRESS, told.PositionStarted(2.0, 5, 1, 0.0, 0.0), RECORD)
    assert (status.progress, status.record, status.kept) == (PROGRESS, RECORD, {4: "no better"})
    assert status.planned_s == 70.0
    assert after(bank, STARTED, RECORD, told.PositionStarted(3.0, 6, 1, 0.0, 0.0)).record is None
    fresh = after(bank, STARTED, KEPT, PROGRESS, RECORD, STARTED)
    assert (fresh.progress, fresh.record, fresh.kept) == (None, None, {})
    ownerless = after(bank, STARTED, RUNNING, KEPT, PROGRESS, owner=None)
    assert (ownerless.state, ownerless.progress, ownerless.kept) == (State.IDLE, None, {4: "no better"})
    assert ownerless.last_event_at is not None


@pytest.mark.parametrize(("pid", "state"), [(7, State.PAUSED), (8, State.IDLE)])
def test_given_a_log_that_ended_then_the_owners_heartbeat_says_the_state(bank, pid, state):
    beat = Heartbeat(datetime.now(UTC), pid, "here", State.PAUSED, "as asked")
    assert after(bank, beat=beat).state is state
