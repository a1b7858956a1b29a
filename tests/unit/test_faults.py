"""Faults on order that end by themselves: an instrument unplugged and plugged in again."""

from __future__ import annotations

import numpy as np
import pytest

from wavefocus.drivers.errors import InstrumentLostError
from wavefocus.drivers.protocols import RecordLabel, RecordRequest
from wavefocus.mocks.virtual.rig import RigFault, VirtualRig, VirtualSettings

RATE_HZ = 10_000.0


def rig_with(*faults: RigFault) -> VirtualRig:
    return VirtualRig(VirtualSettings(fault_plan=faults))


@pytest.mark.parametrize("tries", [0, 1, 3])
def test_given_an_unplugged_mirror_then_it_is_back_after_so_many_tries(tries):
    mirror = rig_with(RigFault("mirror", "move_to", "unplugged", at_call=2, tries=tries)).instruments.mirror
    mirror.move_to(1.0, 1.0)
    for ask in (lambda: mirror.move_to(2.0, 2.0), mirror.identify, mirror.park):
        with pytest.raises(InstrumentLostError):
            ask()
    for _ in range(tries):
        with pytest.raises(InstrumentLostError):
            mirror.reconnect()
    mirror.reconnect()
    mirror.move_to(2.0, 2.0)
    assert mirror.identify()


def test_a_recorder_unplugged_in_a_take_then_the_same_take_succeeds_when_it_is_back():
    recorder = rig_with(RigFault("recorder", "read", "unplugged", position=4, tries=0)).instruments.recorder
    request = RecordRequest(1000, RATE_HZ, (2.0, 1.0), RecordLabel(4, 1, 0))
    recorder.start(request)
    with pytest.raises(InstrumentLostError, match="position 4"):
        recorder.read(1.0)
    recorder.reconnect()
    recorder.start(request)
    assert recorder.read(1.0).volts.shape == (2, 1000)


def test_given_a_fresh_connection_then_no_record_is_under_way_and_nothing_sounds():
    roles = rig_with().instruments
    roles.recorder.start(RecordRequest(1000, RATE_HZ, (2.0, 1.0), RecordLabel(0, 1, 0)))
    roles.recorder.reconnect()
    roles.player.play({20: np.full(1000, 0.5)}, RATE_HZ)
    roles.player.reconnect()
    roles.recorder.start(RecordRequest(1000, RATE_HZ, (2.0, 1.0), RecordLabel(0, 1, 0)))
    assert np.abs(roles.recorder.read(1.0).volts[0]).max() < 0.01


def test_given_a_lost_recorder_then_no_fresh_connection_helps():
    recorder = rig_with(RigFault("recorder", "identify", "lost", at_call=1)).instruments.recorder
    with pytest.raises(InstrumentLostError):
        recorder.identify()
    for _ in range(5):
        with pytest.raises(InstrumentLostError):
            recorder.reconnect()


@pytest.mark.parametrize(
    ("changes", "named"),
    [({"count": 2}, "count is 2"), ({"tries": -1}, "tries -1"), ({"operation": "reconnect"}, "mirror reconnect")],
)
def test_given_an_unplugging_that_cannot_be_then_it_is_named(changes, named):
    entry = {"role": "mirror", "operation": "park", "kind": "unplugged", "at_call": 1, **changes}
    with pytest.raises(ValueError, match=named):
        RigFault(**entry)
