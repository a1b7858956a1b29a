"""Calls in a thread of their own: what they return, what they raise, and what becomes of a wait broken off."""

import _thread
import threading
import time
from types import SimpleNamespace

import pytest

from tests.lab_files import rig_fault
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.process import DriverProcess
from wavefocus.drivers.protocols import Mirror, Player, Recorder, WallClock
from wavefocus.drivers.shutter import ShutteredMirror
from wavefocus.drivers.timeouts import BoundedMirror, BoundedPlayer, BoundedRecorder, CallThread
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings

SOON_S = 0.05


@pytest.mark.parametrize("urgent", [False, True])
def test_given_a_wait_broken_off_then_the_next_call_waits_for_it_unless_it_is_urgent(interruptible, urgent):
    thread, release, done = CallThread("test"), threading.Event(), []

    def hold():
        # What Ctrl-C does: the main thread stops waiting while the call goes on.
        _thread.interrupt_main()
        release.wait()
        done.append("held")

    with pytest.raises(KeyboardInterrupt):
        thread.call(hold, 30.0)
    if not urgent:
        threading.Timer(SOON_S, release.set).start()
    thread.call(lambda: done.append("next"), 30.0, wait_before_s=0.0 if urgent else None)
    assert done == (["next"] if urgent else ["held", "next"])
    release.set()
    thread.abandon()


def test_a_failure_comes_with_its_role_and_closed_instruments_say_so_and_close_twice():
    rig = VirtualRig(VirtualSettings(fault_plan=(rig_fault("mirror", "move_to", "lost", at_call=1),)))
    mirror = BoundedMirror(rig.mirror, 5.0)
    with pytest.raises(InstrumentLostError, match="does not answer any more") as lost:
        mirror.move_to(0.0, 0.0)
    assert lost.value.role == "mirror"
    for instrument in (mirror, BoundedRecorder(rig.recorder, 5.0), BoundedPlayer(rig.player, 5.0)):
        instrument.close()
        instrument.close()
        with pytest.raises(InstrumentError, match="closed"):
            instrument.identify()


def test_without_a_new_thread_instruments_fall_silent_and_nothing_else_is_done(monkeypatch):
    done = []

    class Noting:
        def __init__(self, name):
            self.name = name

        def __getattr__(self, what):
            return lambda *_: done.append(f"{self.name} {what}")

    def refuse(_thread):
        raise RuntimeError("can't start new thread")

    mirror, player = BoundedMirror(Noting("mirror"), 5.0), BoundedPlayer(Noting("player"), 5.0)
    recorder = BoundedRecorder(Noting("recorder"), 5.0)
    monkeypatch.setattr(threading.Thread, "start", refuse)
    with pytest.raises(RuntimeError):
        mirror.move_to(1.0, 1.0)
    for fall_silent in (player.mute, recorder.abort, mirror.park, player.close, mirror.close):
        fall_silent()
    assert done == ["player mute", "recorder abort", "mirror park", "player close", "mirror close"]


def test_given_answers_within_one_step_of_the_clock_then_the_process_is_asked_on(monkeypatch):
    answers, began_s, step_s = [], time.monotonic(), 60.0
    coarse = SimpleNamespace(monotonic=lambda: began_s + (time.monotonic() - began_s) // step_s * step_s)
    monkeypatch.setattr("wavefocus.drivers.process.time", coarse)
    process = DriverProcess("wavefocus.drivers.daq.ni.ni_process", "the process", answers.append)
    assert process.wait_for(lambda: len(answers) > 2 or None, began_s + SOON_S)
    process.close()


@pytest.mark.parametrize(
    ("wrapper", "role"),
    [(ShutteredMirror, Mirror), (BoundedMirror, Mirror), (BoundedRecorder, Recorder), (BoundedPlayer, Player)],
)
def test_every_call_of_a_role_is_passed_on_to_the_device(wrapper, role):
    assert [name for name in dir(role) if name[0] != "_" and getattr(wrapper, name) is getattr(role, name)] == []


def test_given_a_coarse_monotonic_clock_then_the_wall_clock_tells_a_millisecond(monkeypatch):
    clock = WallClock()
    with monkeypatch.context() as windows:
        windows.setattr(time, "monotonic", lambda: 0.0)
        began_s = clock.now_s()
        clock.sleep(1e-3)
        assert clock.now_s() > began_s
