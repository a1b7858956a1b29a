"""What every mirror must do."""

import pytest

from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import Mirror


def test_a_direction_within_reach_settles_in_time_and_waiting_again_returns(bench):
    mirror, clock = bench.instruments.mirror, bench.instruments.clock
    assert isinstance(mirror, Mirror)
    assert mirror.identify().strip()
    assert mirror.identity.product.strip()
    mirror.move_to(*bench.reachable_mrad)
    for _ in range(2):
        before_s = clock.now_s()
        mirror.wait_settled(bench.settle_timeout_s)
        assert clock.now_s() - before_s <= bench.settle_timeout_s


def test_a_direction_out_of_reach_is_refused_whole_and_the_next_move_works(bench):
    mirror = bench.instruments.mirror
    with pytest.raises(InstrumentError) as caught:
        mirror.move_to(*bench.unreachable_mrad)
    bench.check_sentence(caught.value, "mirror")
    mirror.move_to(*bench.reachable_mrad)
    mirror.wait_settled(bench.settle_timeout_s)


def test_it_parks_from_any_state_and_without_time_to_settle_waiting_fails(bench):
    mirror = bench.instruments.mirror
    for _ in range(2):
        mirror.park()
        mirror.move_to(*bench.reachable_mrad)
        with pytest.raises(InstrumentError):
            mirror.wait_settled(0.0)
    mirror.park()
    mirror.wait_settled(bench.settle_timeout_s)


def test_given_a_closed_mirror_then_closing_is_harmless_and_moving_is_refused(bench):
    mirror = bench.instruments.mirror
    mirror.close()
    mirror.close()
    with pytest.raises(InstrumentError):
        mirror.move_to(*bench.reachable_mrad)
