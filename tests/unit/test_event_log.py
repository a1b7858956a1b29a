"""The log beside a bank, read from its end."""

import pytest

from wavefocus.campaign.sidecar_files import last_events, log_path
from wavefocus.config.messages.campaign import PositionKept, event_line


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
