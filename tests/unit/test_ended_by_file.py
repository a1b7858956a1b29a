"""A command that is ended by a file does so as by Ctrl-C."""

import threading
from pathlib import Path

import pytest

from wavefocus.ended_by_file import ended_by_file

LONG_S = 60.0


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
