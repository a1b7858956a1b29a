"""Heartbeat and orders: the files beside a bank by which processes talk."""

import threading
import time
from datetime import UTC, datetime, timedelta

import pytest

from wavefocus.acquisition.engine.session import StopRequest
from wavefocus.campaign.control import (
    CampaignControl,
    give_order,
    heartbeat_path,
    orders_path,
    read_heartbeat,
    take_order,
    withdraw,
    write_heartbeat,
)
from wavefocus.campaign.status import Heartbeat
from wavefocus.config.messages.campaign import State, StateChanged


def _until(condition, seconds: float = 30.0) -> None:
    until_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until_s
        time.sleep(0.005)


def test_given_a_beat_then_it_is_read_as_it_was_written(tmp_path):
    bank, now = tmp_path / "plate.h5", datetime.now(UTC)
    beat = Heartbeat(now, 12, "here", "running", "why", now, 7, 3, 9, 60.0, "a fault", "abc")
    write_heartbeat(bank, beat)
    assert read_heartbeat(bank) == beat
    assert beat.finish_at == now + timedelta(minutes=1)
    assert beat.age_s(now + timedelta(seconds=40)) == 40.0
    assert [one.name for one in tmp_path.iterdir()] == ["plate.h5.heartbeat"]


@pytest.mark.parametrize(
    ("ahead_s", "silent"), [(-1.0, False), (-40.0, True), (0.5, False), (40.0, True), (3600.0, True), (-3e8, True)]
)
def test_a_clock_that_was_set_back_then_an_old_heartbeat_is_silent_all_the_same(ahead_s, silent):
    now = datetime.now(UTC)
    assert Heartbeat(now + timedelta(seconds=ahead_s), 12, "here").is_silent(now) is silent


@pytest.mark.parametrize(
    "text", ["", "{", "[1]", '{"at": 1}', '{"at": "2026-01-01T00:00:00", "pid": 1, "host": "h"}', '{"at": "x"}',
             '{"at": "2026-01-01T00:00:00+00:00", "pid": 1, "host": "h", "state": "dancing"}']
)  # fmt: skip
def test_given_a_heartbeat_that_is_none_then_there_is_none(tmp_path, text):
    heartbeat_path(tmp_path / "plate.h5").write_text(text, encoding="utf-8")
    assert read_heartbeat(tmp_path / "plate.h5") is None


def test_given_an_order_then_it_is_taken_once(tmp_path):
    bank = tmp_path / "plate.h5"
    assert take_order(bank) is None
    order = give_order(bank, "pause")
    assert take_order(bank) == order
    assert take_order(bank) is None
    assert list(tmp_path.iterdir()) == []


def test_two_orders_then_the_later_one_counts_and_the_earlier_cannot_withdraw_it(tmp_path):
    bank = tmp_path / "plate.h5"
    first, second = give_order(bank, "pause"), give_order(bank, "stop")
    withdraw(bank, first)
    assert take_order(bank) == second
    withdraw(bank, give_order(bank, "stop"))
    assert take_order(bank) is None


@pytest.mark.parametrize("text", ["", "{", '{"order": "explode", "number": "1"}', '{"order": "stop"}', "[]"])
def test_given_something_that_is_no_order_then_it_is_taken_away_and_nothing_happens(tmp_path, text):
    bank = tmp_path / "plate.h5"
    orders_path(bank).write_text(text, encoding="utf-8")
    assert take_order(bank) is None
    assert not orders_path(bank).exists()


def test_given_orders_while_it_attends_then_they_are_obeyed_and_acknowledged(tmp_path):
    bank, stop = tmp_path / "plate.h5", StopRequest()
    give_order(bank, "stop")  # left over from a session long ago
    with CampaignControl(bank, stop):
        for word, obeyed in (
            ("pause", lambda: stop.pause_requested),
            ("go-on", lambda: not stop.pause_requested),
            ("stop", lambda: stop.requested),
        ):
            order = give_order(bank, word)
            _until(lambda order=order: (beat := read_heartbeat(bank)) is not None and beat.order == order.number)
            assert obeyed()
    assert not orders_path(bank).exists()


def test_a_heartbeat_that_cannot_be_written_is_told_once_and_orders_work(tmp_path, capsys):
    bank, stop = tmp_path / "plate.h5", StopRequest()
    heartbeat_path(bank).mkdir()
    with CampaignControl(bank, stop) as control:
        for number in range(5):
            control(StateChanged(float(number), State.RUNNING, "again"))
            time.sleep(0.02)
        give_order(bank, "stop")
        _until(lambda: stop.requested)
    assert capsys.readouterr().err.count("heartbeat of") == 1


def test_given_an_order_laid_while_another_is_taken_then_it_is_not_lost(tmp_path):
    bank = tmp_path / "plate.h5"
    for _ in range(50):
        taken = []
        taker = threading.Thread(target=lambda taken=taken: taken.append(take_order(bank)))
        give_order(bank, "pause")
        taker.start()
        last = give_order(bank, "stop")
        taker.join()
        taken.append(take_order(bank))
        assert last in taken
        assert list(tmp_path.iterdir()) == []
