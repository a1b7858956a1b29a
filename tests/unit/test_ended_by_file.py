"""A command that is ended by a file does so as by Ctrl-C."""

import signal
import threading
from collections.abc import Generator
from pathlib import Path

import pytest

from wavefocus.ending import ended_by_file

LONG_S = 60.0


@pytest.fixture
def interruptible() -> Generator[None]:
    """Where the tests run in a shell's background, SIGINT is ignored from the start."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, former)


@pytest.mark.usefixtures("interruptible")
def test_given_the_file_then_the_block_is_interrupted_and_the_file_taken_away(tmp_path: Path) -> None:
    order = tmp_path / "verify.stop"

    def work() -> None:
        with ended_by_file(order):
            order.touch()
            threading.Event().wait(LONG_S)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert not order.exists()


def test_given_a_file_of_before_then_it_is_no_order(tmp_path: Path) -> None:
    order = tmp_path / "verify.stop"
    order.touch()
    with ended_by_file(order):
        assert not order.exists()
    assert not [thread for thread in threading.enumerate() if thread.name == "order to end"]
