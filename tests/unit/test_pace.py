"""Remaining time from the latest positions."""

import pytest

from wavefocus.acquisition.plan import CampaignPace


def _measured(pace: CampaignPace, start_s: float, attempt_s: list[float]) -> float:
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
