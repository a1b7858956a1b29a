"""Events as JSON-ready records."""

import json

from acquisition.engine.events import PositionCommitted, SessionEnded, State, event_record


def test_given_an_event_then_its_record_names_its_kind_and_fields() -> None:
    record = event_record(PositionCommitted(1.5, 7, 1, 2, 41.0, -38.0, 30.0, 120.25))
    assert record["event"] == "position_committed"
    assert record["position"] == 7
    assert record["attempts"] == 2


def test_given_figures_that_are_not_finite_then_the_record_is_still_json() -> None:
    record = event_record(PositionCommitted(1.5, 7, 8, 3, float("nan"), float("inf"), 0.0, 0.0))
    assert json.loads(json.dumps(record, allow_nan=False))["snr_db"] is None
    assert record["residual_db"] is None


def test_given_a_state_then_its_word_is_written() -> None:
    record = event_record(SessionEnded(2.0, State.STOPPED, 3, 6, {"valid": 3}))
    assert json.loads(json.dumps(record))["state"] == "stopped"
    assert record["counts"] == {"valid": 3}
