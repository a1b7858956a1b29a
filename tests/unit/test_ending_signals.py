"""Signals that end a campaign, here and where there are others."""

import os
import signal
from types import SimpleNamespace

import pytest

from wavefocus.acquisition.engine.session import StopRequest
from wavefocus.ending import TERMINAL_GONE, EndingSignals, stop_on_signals


def test_windows_then_a_closed_console_ends_it_at_once_and_no_signal_is_missing():
    windows = SimpleNamespace(SIGINT=2, SIGTERM=15, SIGBREAK=21)
    signals = EndingSignals.here(windows)
    assert (signals.finish, signals.terminal_gone, signals.at_once) == ((2,), (), (15, 21))
    assert signals.all == (2, 15, 21)


POSIX = pytest.mark.skipif(os.name != "posix", reason="Windows has no SIGHUP")


@POSIX
@pytest.mark.may_skip("Windows has no SIGHUP")
def test_terminal_that_is_gone_then_position_is_finished_and_twice_changes_nothing():
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup the tests inherit that it is ignored
    try:
        stop = StopRequest()
        with stop_on_signals(stop):
            signal.raise_signal(signal.SIGHUP)
            signal.raise_signal(signal.SIGHUP)
            assert stop.requested
        assert stop.reason == TERMINAL_GONE
    finally:
        signal.signal(signal.SIGHUP, before)


@POSIX
@pytest.mark.may_skip("Windows has no SIGHUP")
def test_given_nohup_then_a_terminal_that_is_gone_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        stop = StopRequest()
        with stop_on_signals(stop):
            signal.raise_signal(signal.SIGHUP)
        assert not stop.requested
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_given_two_who_stop_it_then_the_first_is_named():
    stop = StopRequest()
    stop.finish_position(TERMINAL_GONE)
    stop.finish_position()
    assert stop.reason == TERMINAL_GONE
