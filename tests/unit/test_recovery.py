"""Waiting for lost instruments and for conditions to return: how long, how often, and who may end it."""

import dataclasses

import numpy as np
import pytest

from tests import lab_files
from wavefocus.acquisition.attempt import Play
from wavefocus.acquisition.engine.recovery import LOSSES_IN_A_ROW, Conditions, Recovery, back_off_s
from wavefocus.acquisition.engine.session import Session, StopRequest
from wavefocus.acquisition.setup import AllowedRange, Watch, point_at
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.config.messages.campaign import ReconnectTried, State
from wavefocus.config.rig import BandSection, default_rig
from wavefocus.configuration import load_rig
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, UnknownFaultError
from wavefocus.drivers.protocols import Recording
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.rig.instruments import openers_of
from wavefocus.rig.setup import open_rig, room_c

LOST = lab_files.rig_fault("mirror", "move_to", "lost", at_call=1)


def setup_of(*faults, recovery_s=600.0):
    return lab_files.setup_of(VirtualRig(VirtualSettings(fault_plan=faults)), recovery_s=recovery_s)


def lost(role="mirror"):
    failure = InstrumentLostError(role, "working", "it is gone", "plug it in")
    failure.role = role
    return failure


class Watched:
    """A recovery with all that it tells."""

    def __init__(self, setup):
        self.events = []
        self.life = Session(setup.clock, self.events.append, StopRequest())
        self.recovery = Recovery(setup, self.life)
        self.life.enter(State.RUNNING, "for the test")

    @property
    def tries(self):
        return [event for event in self.events if isinstance(event, ReconnectTried)]


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
    assert setup.clock.now_s() == pytest.approx(recovery_s)
    watched.life.enter(State.RUNNING, "for the test")
    assert watched.life.working_s()[0] == pytest.approx(0.0)  # to wait is no work


def test_instrument_that_is_lost_again_and_again_then_it_is_not_connected_for_ever():
    setup = setup_of()
    watched = Watched(setup)

    def measure():
        raise lost("player")

    with pytest.raises(InstrumentLostError, match=f"also after {LOSSES_IN_A_ROW} fresh connections in a row"):
        watched.recovery.retry_after_reconnect(measure)
    assert len(watched.tries) == LOSSES_IN_A_ROW
    # Each is waited for longer than the one before, so that nothing spins.
    assert setup.clock.now_s() == pytest.approx(sum(map(back_off_s, range(LOSSES_IN_A_ROW))))


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
    mute = lab_files.rig_fault("player", "mute", "timeout", at_call=1, count=10**6)
    setup = setup_of(lab_files.rig_fault("mirror", "move_to", "unplugged", at_call=1, tries=0), mute, recovery_s=60.0)
    watched = Watched(setup)
    with pytest.raises(InstrumentLostError, match=r"player: muting: .*not cured within"):
        watched.recovery.retry_after_reconnect(lambda: point_at(setup, 0.0, 0.0))
    assert 60.0 <= setup.clock.now_s() < 120.0


def test_given_another_device_in_its_place_then_nobody_waits_for_it():
    class Impostor:
        def reconnect(self):
            raise InstrumentError("mirror", "connecting", "it says it is a printer", "plug the mirror in")

        def block(self):
            pass

    setup = setup_of()
    odd = dataclasses.replace(setup, mirror=Impostor())
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

    setup = lab_files.setup_of(rig, player=Hanging())
    with pytest.raises(KeyboardInterrupt):
        setup.close()
    with pytest.raises(InstrumentError, match="closed"):
        rig.mirror.move_to(0.0, 0.0)


RATE_HZ = 10_000.0
EXCITATION = PlayedExcitation(RATE_HZ, 20.0, 500.0, 1.0, 0.2, 1.0, 1)
SIGNAL_V = EXCITATION.signal_v()
PLAY = Play(0, {0: SIGNAL_V, 20: SIGNAL_V})


def _conditions(sensor=None, **bands):
    watch = Watch(bands, {} if sensor is None else {"room": sensor})
    return Conditions(lab_files.setup_of(VirtualRig(), reference_gain=0.5, watch=watch), EXCITATION)


def _recording(reference_gain, noise_v):
    generator = np.random.default_rng(1)
    volts = np.zeros((2, len(SIGNAL_V) + 1200), np.float32)
    volts[0, 300 : 300 + len(SIGNAL_V)] = reference_gain * SIGNAL_V
    volts[1, 300 : 300 + len(SIGNAL_V)] = 3.0 * SIGNAL_V
    volts[1] += noise_v * generator.standard_normal(volts.shape[1], dtype=np.float32)
    return Recording(volts, (1e-4, 1e-4), (False, False))


@pytest.mark.parametrize(("gain", "level_db"), [(0.5, 0.0), (0.25, -6.02), (1.0, 6.02), (0.0, -np.inf)])
def test_a_record_then_the_reference_level_is_told_against_what_the_drive_makes(gain, level_db):
    conditions = _conditions(reference=AllowedRange("reference level", "dB", BandSection(leaves_below=-200.0)))
    found_db = conditions.values([PLAY], [_recording(gain, 0.0)], pytest.fail)["reference"]
    assert found_db == pytest.approx(level_db, abs=0.01) if gain else found_db < -100.0


@pytest.mark.parametrize("noises_v", [[1e-3], [0.05], [1.0], [1e-3] * 4 + [1.0]])
def test_given_noise_under_a_loud_response_then_its_rms_in_most_records_is_found(noises_v):
    conditions = _conditions(noise=AllowedRange("noise", "V", BandSection(leaves_above=200.0)))
    recordings = [_recording(0.5, noise_v) for noise_v in noises_v]
    found_v = conditions.values([PLAY] * len(recordings), recordings, pytest.fail)["noise"]
    assert found_v == pytest.approx(noises_v[0], rel=0.1)


def test_given_a_sensor_that_fails_then_its_value_is_unknown_and_the_failure_is_told():
    room_c, failures = [], []

    def read():
        if not room_c:
            raise InstrumentError("thermometer", "reading", "it is silent", "look after it")
        return room_c[0]

    conditions = _conditions(read, room=AllowedRange("room temperature", "degrees C", BandSection(leaves_below=18.0)))
    assert conditions.values([], [], failures.append) == {}
    assert "silent" in str(failures.pop())
    room_c.append(15.0)
    values = conditions.values([], [], failures.append)
    assert failures == []
    assert "below 18" in conditions.left(values)


def _rig(tmp_path, text):
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    return load_rig(tmp_path / "rig.toml")


def watch_of(rig):
    return open_rig(openers_of(rig)).watch


def test_a_band_is_left_on_one_threshold_and_entered_on_another_a_tenth_inside(tmp_path):
    limits = BandSection(leaves_below=18.0, leaves_above=26.0, returns_above=19.0, returns_below=25.0)
    band = AllowedRange("room temperature", "degrees C", limits)
    assert band.left(17.9) == "room temperature 17.9 degrees C is below 18 degrees C"
    assert band.left(26.5) == "room temperature 26.5 degrees C is above 26 degrees C"
    assert band.left(18.5) == ""
    assert [band.is_back(value_c) for value_c in (18.5, 19.0, 25.5)] == [False, True, False]
    rig = _rig(tmp_path, "[watch.reference]\nleaves_below = -3\nleaves_above = 2.0\nsettle_s = 5")
    band = watch_of(rig).bands["reference"].band
    assert (band.leaves_below, band.returns_above) == (-3.0, pytest.approx(-2.7))
    assert (band.leaves_above, band.returns_below) == (2.0, pytest.approx(1.8))
    assert band.settle_s == 5.0
    # Without a lower limit any low value is well.
    noise = watch_of(_rig(tmp_path, "[watch.noise]\nleaves_above = 0.01")).bands["noise"]
    assert noise.is_back(-1e300)
    assert not noise.left(-1e300)


def test_sensors_of_the_rig_or_a_transmitter_are_asked_for_what_is_watched(tmp_path):
    rig = _rig(tmp_path, "[watch.room]\nleaves_below = 18\n[watch.light]\nleaves_below = 0.2")
    watch = watch_of(rig)
    assert {name: sensor() for name, sensor in watch.sensors.items()} == {"room": 21.0, "light": 1.0}
    assert watch_of(default_rig()).sensors == {}

    class Box:
        def read_input_v(self, name):
            return {"ai3": 0.25}[name]

    rig = _rig(tmp_path, '[watch.room]\nleaves_below = 18\ninput = "ai3"\ncelsius_per_v = 80.0\ncelsius_at_0_v = 1.5')
    assert room_c(Box(), rig.watch.room) == 21.5
