"""Work shared out to threads."""

from __future__ import annotations

import threading

import pytest

from rendering.shared_work import share_out
from rendering.threads import WORKERS


@pytest.mark.parametrize("count", [0, 1, 2, 50])
def test_each_item_is_done_once(count):
    done = []
    share_out(range(count), done.append)
    assert sorted(done) == list(range(count))


def test_all_workers_take_part_and_the_calling_thread_is_one_of_them():
    together = threading.Barrier(WORKERS)
    threads = set()

    def task(_):
        # Passes only when each item is held by a thread of its own.
        together.wait(timeout=60)
        threads.add(threading.get_ident())

    share_out(range(WORKERS), task)
    assert len(threads) == WORKERS
    assert threading.get_ident() in threads


@pytest.mark.parametrize("bad", [0, 7])
def test_an_error_stops_the_rest_and_is_raised(bad):
    done = []

    def task(item):
        if item == bad:
            raise ValueError(f"item {item}")
        done.append(item)

    with pytest.raises(ValueError, match=f"item {bad}"):
        share_out(range(100_000), task)
    assert bad not in done
    assert len(done) < 99_999
