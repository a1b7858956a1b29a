"""Events of a campaign as lines of a log, and the log read from its end."""

import json

import pytest

from wavefocus.campaign.sidecar_files import last_events, log_path
from wavefocus.config.messages.campaign import (
    PositionCommitted,
    PositionKept,
    SessionEnded,
    State,
    event_line,
    read_event,
)


def test_given_an_event_then_its_line_names_its_kind_and_fields_and_is_read_again():
    event = PositionCommitted(1.5, 7, 1, 2, 41.0, -38.0, 30.0, 120.25, defects=("clipped",))
    record = json.loads(event_line(event))
    assert (record["event"], record["position"], record["attempts"]) == ("position_committed", 7, 2)
    logged = read_event(event_line(event).encode())
    assert logged is not None
    assert logged.event == event


def test_given_figures_that_are_not_finite_then_the_line_is_still_json():
    record = json.loads(event_line(PositionCommitted(1.5, 7, 8, 3, float("nan"), float("inf"), 0.0, 0.0)))
    assert record["snr_db"] is None
    assert record["residual_db"] is None


def test_given_a_state_then_its_word_is_written():
    record = json.loads(event_line(SessionEnded(2.0, State.STOPPED, 3, 6, {"valid": 3})))
    assert record["state"] == "stopped"
    assert record["counts"] == {"valid": 3}


@pytest.mark.parametrize(
    "line",
    [
        b'{"at": "2026-01-01T00:00:00+00:00", "event": "prog',
        b'{"at": "2026-01-01T00:00:00+00:00", "event": "of_a_later_version"}',
        b'{"at": "2026-01-01T00:00:00+00:00", "event": "state_changed", "state": "dancing", "reason": ""}',
        b'{"event": "position_kept"}',
        b"[1, 2]",
        b"",
    ],
)
def test_given_a_line_that_is_no_event_then_it_is_passed_over(line):
    assert read_event(line) is None


@pytest.mark.parametrize("padding", [0, 60, 70_000])
def test_given_a_long_log_then_its_events_come_newest_first_and_none_is_missing(tmp_path, padding):
    bank = tmp_path / "plate.h5"
    events = [PositionKept(0.0, number, 1, "x" * padding) for number in range(3000 if padding < 1000 else 5)]
    log_path(bank).write_text("".join(map(event_line, events)), encoding="utf-8")
    assert [logged.event for logged in last_events(bank)] == events[::-1]


def test_given_a_torn_last_line_then_the_one_before_is_the_newest(tmp_path):
    bank, kept = tmp_path / "plate.h5", PositionKept(0.0, 1, 1, "")
    log_path(bank).write_text(event_line(kept) + '[1, 2]\n\n{"event": "prog', encoding="utf-8")
    assert [logged.event for logged in last_events(bank)] == [kept]


def test_given_no_log_then_there_are_no_events(tmp_path):
    assert list(last_events(tmp_path / "plate.h5")) == []
