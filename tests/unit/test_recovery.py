"""Waiting for lost instruments: how long, how often, and who may end it."""

import dataclasses

import pytest

from tests import lab_files
from wavefocus.acquisition.engine.recovery import LOSSES_IN_A_ROW, Recovery, back_off_s
from wavefocus.acquisition.engine.session import Session, StopRequest
from wavefocus.acquisition.setup import point_at
from wavefocus.config.messages.campaign import Event, ReconnectTried, State, StateChanged
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, UnknownFaultError
from wavefocus.drivers.protocols import Instruments
from wavefocus.mocks.virtual.rig import RigFault, VirtualRig, VirtualSettings

LOST = RigFault("mirror", "move_to", "lost", at_call=1)


def setup_of(*faults, recovery_s=600.0):
    return lab_files.setup_of(VirtualRig(VirtualSettings(fault_plan=faults)), recovery_s=recovery_s)


def lost(role="mirror"):
    failure = InstrumentLostError(role, "working", "it is gone", "plug it in")
    failure.role = role
    return failure


class Watched:
    """A recovery with all that it tells."""

    def __init__(self, setup):
        self.events: list[Event] = []
        self.life = Session(setup.instruments.clock, self.events.append, StopRequest())
        self.recovery = Recovery(setup, self.life)
        self.life.enter(State.RUNNING, "for the test")

    @property
    def tries(self):
        return [event for event in self.events if isinstance(event, ReconnectTried)]

    @property
    def states(self):
        return [event.state for event in self.events if isinstance(event, StateChanged)]


def test_given_an_instrument_that_comes_back_then_the_interrupted_work_is_done_again():
    setup = setup_of(RigFault("mirror", "move_to", "unplugged", at_call=2, tries=2))
    watched = Watched(setup)
    done = []

    def measure():
        for x_mm in (1.0, 2.0):
            point_at(setup, x_mm, 0.0)
            done.append(x_mm)
        return "measured"

    assert watched.recovery.retry_after_reconnect(measure) == "measured"
    assert done == [1.0, 1.0, 2.0]
    assert watched.states == [State.RUNNING, State.RECOVERING, State.RUNNING]
    assert [one.connected for one in watched.tries] == [False, False, True]
    assert watched.life.time_s() - watched.life.working_s()[0] == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("recovery_s", "waits"), [(10.0, [1.0, 2.0, 4.0, 3.0, None]), (0.5, [0.5, None]), (0.0, [None])]
)
def test_an_instrument_that_stays_away_then_the_last_try_is_when_the_time_is_over(recovery_s, waits):
    setup = setup_of(LOST, recovery_s=recovery_s)
    watched = Watched(setup)
    with pytest.raises(InstrumentLostError, match=f"not back within .*, {len(waits)} tries") as caught:
        watched.recovery.retry_after_reconnect(lambda: point_at(setup, 0.0, 0.0))
    assert "mirror: moving to" in str(caught.value)
    assert "check its cable" in caught.value.remedy
    assert [one.next_try_s for one in watched.tries] == pytest.approx(waits)
    assert watched.tries[-1].gives_up_s == 0.0
    assert setup.instruments.clock.now_s() == pytest.approx(recovery_s)


def test_instrument_that_is_lost_again_and_again_then_it_is_not_connected_for_ever():
    setup = setup_of()
    watched = Watched(setup)

    def measure():
        raise lost("player")

    with pytest.raises(InstrumentLostError, match=f"also after {LOSSES_IN_A_ROW} fresh connections in a row"):
        watched.recovery.retry_after_reconnect(measure)
    assert len(watched.tries) == LOSSES_IN_A_ROW
    # Each is waited for longer than the one before, so that nothing spins.
    assert setup.instruments.clock.now_s() == pytest.approx(sum(map(back_off_s, range(LOSSES_IN_A_ROW))))


def test_an_unknown_failure_is_tried_once_more_and_final_when_it_recurs():
    setup = setup_of()
    watched = Watched(setup)
    calls = []

    def measure(fails):
        calls.append(None)
        if fails(len(calls)):
            unknown = UnknownFaultError("recorder", "recording", "code -1", "look it up")
            unknown.role = "recorder"
            raise unknown
        return "measured"

    # Cured by a fresh connection, twice in one campaign.
    for _ in range(2):
        assert watched.recovery.retry_after_reconnect(lambda: measure(lambda call: call % 2 == 1)) == "measured"
    assert [(one.role, one.connected) for one in watched.tries] == [("recorder", True)] * 2
    calls.clear()
    with pytest.raises(InstrumentLostError) as caught:
        watched.recovery.retry_after_reconnect(lambda: measure(lambda call: True))
    assert (len(calls), len(watched.tries)) == (2, 3)
    assert caught.value.role == "recorder"
    assert "code -1" in caught.value.cause


def test_a_player_that_cannot_be_muted_then_its_fresh_connections_come_to_an_end():
    mute = RigFault("player", "mute", "timeout", at_call=1, count=10**6)
    setup = setup_of(RigFault("mirror", "move_to", "unplugged", at_call=1, tries=0), mute, recovery_s=60.0)
    watched = Watched(setup)
    with pytest.raises(InstrumentLostError, match=r"player: muting: .*not cured within"):
        watched.recovery.retry_after_reconnect(lambda: point_at(setup, 0.0, 0.0))
    assert 60.0 <= setup.instruments.clock.now_s() < 120.0


def test_given_a_measurement_between_two_losses_then_the_waits_begin_anew():
    faults = [RigFault("mirror", "move_to", "unplugged", at_call=call, tries=1) for call in (1, 3)]
    setup = setup_of(*faults)
    watched = Watched(setup)
    for _ in range(2):
        watched.recovery.retry_after_reconnect(lambda: point_at(setup, 0.0, 0.0))
    assert [one.number for one in watched.tries] == [1, 2, 1, 2]


def test_given_another_device_in_its_place_then_nobody_waits_for_it():
    class Impostor:
        def reconnect(self):
            raise InstrumentError("mirror", "connecting", "it says it is a printer", "plug the mirror in")

        def block(self):
            pass

    setup = setup_of()
    odd = dataclasses.replace(setup, instruments=dataclasses.replace(setup.instruments, mirror=Impostor()))
    watched = Watched(odd)

    def measure():
        raise lost()

    with pytest.raises(InstrumentError, match="it says it is a printer"):
        watched.recovery.retry_after_reconnect(measure)
    assert [(one.connected, one.next_try_s) for one in watched.tries] == [(False, None)]


def test_ctrl_c_on_the_way_out_then_one_step_is_cut_short_and_the_others_are_tried():
    rig = VirtualRig(VirtualSettings())

    class Hanging:
        def mute(self):
            raise KeyboardInterrupt

        def close(self):
            pass

    instruments: Instruments = dataclasses.replace(rig.instruments, player=Hanging())
    setup = dataclasses.replace(setup_of(), instruments=instruments)
    with pytest.raises(KeyboardInterrupt):
        setup.close()
    with pytest.raises(InstrumentError, match="closed"):
        rig.instruments.mirror.move_to(0.0, 0.0)
