"""How signals and a file become a stop of a command."""

import os
import signal
import threading
from types import SimpleNamespace

import pytest

from wavefocus.__main__ import raise_at_interrupt
from wavefocus.acquisition.engine.session import BY_THE_USER, StopRequest
from wavefocus.ending import TERMINAL_GONE, EndingSignals, ended_by_file, ending_at_once, stop_on_signals


def test_the_first_interrupt_stops_the_second_ends_and_a_third_disturbs_nothing():
    stop = StopRequest()
    with stop_on_signals(stop):
        signal.raise_signal(signal.SIGINT)
        assert stop.requested
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        stop.finish_position(TERMINAL_GONE)
    assert stop.reason == BY_THE_USER  # whoever stops it first is named


def test_windows_then_a_closed_console_ends_it_at_once_and_no_signal_is_missing():
    windows = SimpleNamespace(SIGINT=2, SIGTERM=15, SIGBREAK=21)
    signals = EndingSignals.here(windows)
    assert (signals.finish, signals.terminal_gone, signals.at_once) == ((2,), (), (15, 21))
    assert signals.all == (2, 15, 21)


POSIX = pytest.mark.skipif(os.name != "posix", reason="Windows has no SIGHUP")


@POSIX
@pytest.mark.may_skip("Windows has no SIGHUP")
def test_given_nohup_then_a_terminal_that_is_gone_changes_nothing():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        stop = StopRequest()
        with stop_on_signals(stop):
            signal.raise_signal(signal.SIGHUP)
            assert not stop.requested
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


LONG_S = 60.0


@pytest.mark.usefixtures("interruptible")
def test_a_file_that_appears_interrupts_the_block_and_one_of_before_is_no_order(tmp_path):
    order = tmp_path / "verify.stop"

    def work():
        with ended_by_file(order):
            order.touch()
            threading.Event().wait(LONG_S)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert not order.exists()
    order.touch()
    with ended_by_file(order):
        assert not order.exists()
    assert not [thread for thread in threading.enumerate() if thread.name == "order to end"]


@pytest.mark.usefixtures("interruptible")
def test_order_that_falls_into_a_finaliser_then_it_is_given_again(tmp_path):
    order = tmp_path / "verify.stop"
    fallen = []

    class Finalised:
        def __del__(self):
            order.touch()
            try:
                threading.Event().wait(LONG_S)
            except KeyboardInterrupt:
                fallen.append(order)
                raise

    def work():
        with ending_at_once(), ended_by_file(order):
            Finalised()
            threading.Event().wait(LONG_S)

    raise_at_interrupt()
    with pytest.raises(KeyboardInterrupt):
        work()
    assert fallen
    assert not order.exists()
