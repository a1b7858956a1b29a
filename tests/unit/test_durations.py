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
        (0.0, "0 s"), (59.4, "59 s"), (59.6, "1 min 00 s"), (3599.6, "1 h 00 min"), (108_000.0, "30 h 00 min"),
        (-5.0, "0 s"), (1e300, "over 100 years"), (float("inf"), "unknown"), (float("nan"), "unknown"),
    ],
)  # fmt: skip
def test_given_seconds_then_words_and_a_clock_whatever_the_finish(seconds, words):
    assert hours(seconds) == words
    assert not abs(seconds) < 1e301 or finish_clock(seconds)


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


def _measured(pace, *attempts_s, start_s=0.0):
    """Measure positions whose attempts take so many seconds; the time then."""
    for seconds in attempts_s:
        for attempt_s in seconds if isinstance(seconds, list) else [seconds]:
            start_s += attempt_s
            pace.done("attempt", start_s)
        pace.position_settled(len(seconds) if isinstance(seconds, list) else 1)
    return start_s


@pytest.mark.parametrize(
    ("attempts_s", "positions", "since_s", "left_s"),
    [
        # One position that stumbled does not move the finish.
        ([10.0] * 5 + [500.0] + [10.0] * 3, 100, None, 1000.0),
        # Repeats are expected of the others too.
        ([10.0, 10.0, [10.0] * 3, 10.0], 4, None, 60.0),
        # What a position under way still takes counts.
        ([10.0] * 3, 2, 4.0, 26.0),
        ([10.0] * 3, 2, 40.0, 20.0),
    ],
)
def test_given_positions_then_the_time_that_is_left_is_that_of_their_like(attempts_s, positions, since_s, left_s):
    pace = CampaignPace(0.0)
    now_s = _measured(pace, *attempts_s)
    when = [] if since_s is None else [now_s + since_s]
    assert pace.remaining_s(positions, 0, *when) == pytest.approx(left_s)


def test_sentinel_measurements_are_no_positions_and_those_to_come_are_counted():
    pace = CampaignPace(0.0)
    now_s = _measured(pace, *[10.0] * 4)
    assert pace.remaining_s(10, 2) == 120.0  # as long as a position, as far as is known
    pace.done("sentinel", now_s + 4.0)
    _measured(pace, *[10.0] * 4, start_s=now_s + 4.0)
    assert pace.position_s == 10.0
    assert pace.remaining_s(10, 2) == 108.0
