"""The log beside a bank, read from its end."""

from __future__ import annotations

import json
from itertools import islice

import pytest

from wavefocus.campaign.sidecar_files import last_events, log_path


@pytest.mark.parametrize("padding", [0, 60, 70_000])
def test_given_a_long_log_then_its_events_come_newest_first_and_none_is_missing(tmp_path, padding):
    bank = tmp_path / "plate.h5"
    count = 3000 if padding < 1000 else 5
    lines = [json.dumps({"event": "progress", "number": number, "pad": "x" * padding}) for number in range(count)]
    log_path(bank).write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert [event["number"] for event in last_events(bank)] == list(range(count))[::-1]


def test_given_a_torn_last_line_then_the_one_before_is_the_newest(tmp_path):
    bank = tmp_path / "plate.h5"
    log_path(bank).write_text('{"event": "progress"}\n[1, 2]\n\n{"event": "prog', encoding="utf-8")
    assert list(last_events(bank)) == [{"event": "progress"}]


def test_given_no_log_then_there_are_no_events(tmp_path):
    assert list(islice(last_events(tmp_path / "plate.h5"), 1)) == []
