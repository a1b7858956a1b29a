"""What every mirror must do."""

import pytest

from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import Mirror


def test_given_a_mirror_then_it_has_the_role_and_a_name(bench):
    assert isinstance(bench.instruments.mirror, Mirror)
    assert bench.instruments.mirror.identify().strip()
    assert bench.instruments.mirror.identity.product.strip()


def test_a_direction_within_reach_settles_in_time_and_waiting_again_returns(bench):
    mirror, clock = bench.instruments.mirror, bench.instruments.clock
    mirror.move_to(*bench.reachable_mrad)
    for _ in range(2):
        before_s = clock.now_s()
        mirror.wait_settled(bench.settle_timeout_s)
        assert clock.now_s() - before_s <= bench.settle_timeout_s


def test_a_direction_out_of_reach_is_refused_whole_and_the_next_move_works(bench):
    mirror = bench.instruments.mirror
    with pytest.raises(InstrumentError) as caught:
        mirror.move_to(*bench.unreachable_mrad)
    error = caught.value
    assert "mirror" in error.instrument
    assert all(text.strip() for text in (error.operation, error.cause, error.remedy))
    mirror.move_to(*bench.reachable_mrad)
    mirror.wait_settled(bench.settle_timeout_s)


def test_given_no_time_to_settle_then_waiting_fails_rather_than_lies(bench):
    mirror = bench.instruments.mirror
    mirror.park()
    mirror.wait_settled(bench.settle_timeout_s)
    mirror.move_to(*bench.reachable_mrad)
    with pytest.raises(InstrumentError):
        mirror.wait_settled(0.0)


def test_given_any_state_then_it_parks(bench):
    mirror = bench.instruments.mirror
    mirror.park()
    mirror.move_to(*bench.reachable_mrad)
    mirror.park()
    mirror.wait_settled(bench.settle_timeout_s)


def test_given_a_closed_mirror_then_closing_is_harmless_and_moving_is_refused(bench):
    mirror = bench.instruments.mirror
    mirror.close()
    mirror.close()
    with pytest.raises(InstrumentError):
        mirror.move_to(*bench.reachable_mrad)
