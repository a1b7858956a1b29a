"""A command that is ended by a file does so as by Ctrl-C."""

import signal
import sys
import threading

import pytest

from wavefocus.__main__ import raise_at_interrupt
from wavefocus.ending import ended_by_file, ending_at_once

LONG_S = 60.0


@pytest.fixture
def interruptible():
    """Where the tests run in a shell's background, SIGINT is ignored from the start."""
    former, hook = signal.signal(signal.SIGINT, signal.default_int_handler), sys.unraisablehook
    yield
    signal.signal(signal.SIGINT, former)
    sys.unraisablehook = hook


@pytest.mark.usefixtures("interruptible")
def test_given_the_file_then_the_block_is_interrupted_and_the_file_taken_away(tmp_path):
    order = tmp_path / "verify.stop"

    def work() -> None:
        with ended_by_file(order):
            order.touch()
            threading.Event().wait(LONG_S)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert not order.exists()


def test_given_a_file_of_before_then_it_is_no_order(tmp_path):
    order = tmp_path / "verify.stop"
    order.touch()
    with ended_by_file(order):
        assert not order.exists()
    assert not [thread for thread in threading.enumerate() if thread.name == "order to end"]


@pytest.mark.usefixtures("interruptible")
def test_order_that_falls_into_a_finaliser_then_it_is_given_again(tmp_path):
    order = tmp_path / "verify.stop"
    fallen = []

    class Finalised:
        def __del__(self) -> None:
            order.touch()
            try:
                threading.Event().wait(LONG_S)
            except KeyboardInterrupt:
                fallen.append(order)
                raise

    def work() -> None:
        with ending_at_once(), ended_by_file(order):
            Finalised()
            threading.Event().wait(LONG_S)

    raise_at_interrupt()
    with pytest.raises(KeyboardInterrupt):
        work()
    assert fallen
    assert not order.exists()
