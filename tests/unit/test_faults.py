"""Faults on order that end by themselves: an instrument unplugged and plugged in again."""

from __future__ import annotations

import pytest

from wavefocus.drivers.errors import InstrumentLostError
from wavefocus.mocks.virtual.rig import RigFault, VirtualRig, VirtualSettings


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


@pytest.mark.parametrize(
    ("changes", "named"),
    [({"count": 2}, "count is 2"), ({"tries": -1}, "tries -1"), ({"operation": "reconnect"}, "mirror reconnect")],
)
def test_given_an_unplugging_that_cannot_be_then_it_is_named(changes, named):
    entry = {"role": "mirror", "operation": "park", "kind": "unplugged", "at_call": 1, **changes}
    with pytest.raises(ValueError, match=named):
        RigFault(**entry)
