"""Durations in words, and the remaining time from the latest positions."""

import time
from datetime import UTC, datetime

import pytest

from wavefocus.acquisition.plan import CampaignPace
from wavefocus.acquisition.wording import finish_time, hours
from wavefocus.console import finish_clock


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.0, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min 00 s"),
        (3599.6, "1 h 00 min"),
        (108_000.0, "30 h 00 min"),
        (-5.0, "0 s"),
        (1e300, "over 100 years"),
        (float("inf"), "unknown"),
        (float("nan"), "unknown"),
    ],
)
def test_given_seconds_then_words(seconds, words):
    assert hours(seconds) == words


@pytest.mark.may_skip("Windows has no tzset")
@pytest.mark.skipif(not hasattr(time, "tzset"), reason="Windows has no tzset")
@pytest.mark.parametrize(
    ("zone", "start", "seconds", "finish"),
    [  # as the zones' own rules have it: POSIX TZ, no other library's arithmetic
        ("CET-1CEST,M3.5.0,M10.5.0/3", "2026-10-24T20:00", 36_000, "2026-10-25T07:00:00+01:00"),
        ("CET-1CEST,M3.5.0,M10.5.0/3", "2026-03-28T20:00", 36_000, "2026-03-29T08:00:00+02:00"),
        ("EST5EDT,M3.2.0,M11.1.0", "2026-11-01T02:00", 36_000, "2026-11-01T07:00:00-05:00"),
        ("AEST-10AEDT,M10.1.0,M4.1.0/3", "2026-10-03T10:00", 36_000, "2026-10-04T07:00:00+11:00"),
        ("UTC0", "2026-10-24T20:00", 36_000, "2026-10-25T06:00:00+00:00"),
    ],
)
def test_given_a_change_of_summer_time_then_the_finish_is_by_the_clock_of_then(
    monkeypatch, zone, start, seconds, finish
):
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    try:
        now = datetime.fromisoformat(start).replace(tzinfo=UTC)
        assert finish_time(seconds, now).isoformat() == finish
        assert finish_time(seconds, now.astimezone()).isoformat() == finish
    finally:
        monkeypatch.undo()
        time.tzset()


def test_given_a_finish_beyond_all_dates_then_there_is_a_time_all_the_same():
    assert finish_clock(1e300)


def _measured(pace, start_s, attempt_s):
    for seconds in attempt_s:
        start_s += seconds
        pace.done("attempt", start_s)
        pace.position_settled(1)
    return start_s


def test_given_one_position_that_stumbled_then_the_finish_does_not_move():
    pace = CampaignPace(0.0)
    _measured(pace, 0.0, [10.0] * 5 + [500.0] + [10.0] * 3)
    assert pace.remaining_s(100, 0) == 1000.0


def test_given_repeats_then_their_time_is_expected_of_the_others_too():
    pace = CampaignPace(0.0)
    now_s = 0.0
    for attempts in (1, 1, 3, 1):
        for _ in range(attempts):
            now_s += 10.0
            pace.done("attempt", now_s)
        pace.position_settled(attempts)
    assert pace.remaining_s(4, 0) == pytest.approx(60.0)


def test_sentinel_measurements_are_no_positions_and_those_to_come_are_counted():
    pace = CampaignPace(0.0)
    now_s = _measured(pace, 0.0, [10.0] * 4)
    assert pace.remaining_s(10, 2) == 120.0  # as long as a position, as far as is known
    pace.done("sentinel", now_s + 4.0)
    _measured(pace, now_s + 4.0, [10.0] * 4)
    assert pace.position_s == 10.0
    assert pace.remaining_s(10, 2) == 108.0


def test_given_a_position_under_way_then_what_it_still_takes_counts():
    pace = CampaignPace(0.0)
    now_s = _measured(pace, 0.0, [10.0] * 3)
    assert pace.remaining_s(2, 0, now_s + 4.0) == 26.0
    assert pace.remaining_s(2, 0, now_s + 40.0) == 20.0
