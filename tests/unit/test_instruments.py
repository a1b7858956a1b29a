"""Opening a rig: in order, and never half."""

import threading
from dataclasses import replace

import pytest

from tests.unit.test_doctor import absent
from wavefocus.acquisition.setup import Openers
from wavefocus.config.rig import RigConfig, default_rig
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.rig.instruments import openers_of
from wavefocus.rig.setup import open_rig


@pytest.mark.parametrize("missing", ["vibrometer", "mirror", "recorder", "player"])
def test_given_one_that_cannot_be_opened_then_those_before_it_are_released(missing):
    openers = openers_of(default_rig())
    roles = ("mirror", "recorder", "player")
    before = {name: getattr(openers, name)() for name in roles}
    broken: Openers = replace(openers, **{missing: absent(missing)})
    with pytest.raises(InstrumentError, match=f"{missing}: opening: it is not there; plug it in"):
        open_rig(broken)
    opened_before = () if missing == "vibrometer" else roles[: roles.index(missing)]
    for name, role in before.items():
        if name in opened_before:
            with pytest.raises(InstrumentError, match="it is closed"):
                role.identify()
        else:
            assert role.identify()


def test_a_mirror_opened_and_nothing_else_then_it_is_parked_before_it_is_released():
    rig = RigConfig.model_validate({"emulation": {"seed": 2}})
    openers = openers_of(rig)
    mirror = openers.mirror()
    mirror.move_to(10.0, 10.0)
    with pytest.raises(InstrumentError):
        open_rig(replace(openers, recorder=absent("recorder")))
    later_ns = round((openers.clock.now_s() + 1) * 1e9)
    assert mirror.motion.aims(later_ns, later_ns + 1) == [(later_ns, rig.mirror.park_mrad)]


def test_a_driver_that_hangs_while_it_opens_is_named_and_nothing_more_is_opened():
    opened = []

    def note():
        opened.append("recorder")
        raise AssertionError

    rig = RigConfig.model_validate({"recovery": {"hung_after_s": 0.05 / 3}})
    openers = replace(openers_of(rig), mirror=lambda: threading.Event().wait(), recorder=note)
    with pytest.raises(InstrumentLostError, match=r"mirror: opening: the call did not come back within 0\.05 s"):
        open_rig(openers)
    assert opened == []
