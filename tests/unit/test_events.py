"""Events of a campaign as lines of a log."""

import json

import pytest

from wavefocus.config.messages.campaign import PositionCommitted, SessionEnded, State, event_line, read_event


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
