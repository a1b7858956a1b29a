"""Work that rendering and prediction share among threads."""

from __future__ import annotations

import threading

import pytest

from wavefocus.rendering.device import WORKERS, threaded_map


@pytest.mark.parametrize("workers", [1, WORKERS])
def test_items_then_results_come_in_their_order_and_a_few_items_are_taken_ahead(workers):
    taken = []

    def items():
        for number in range(20):
            taken.append(number)
            yield number

    for number, result in enumerate(threaded_map(lambda item: item**2, items(), workers)):
        assert result == number**2
        assert len(taken) <= number + workers + 2
    assert taken == list(range(20))


def test_given_several_workers_then_they_work_side_by_side():
    together = threading.Barrier(WORKERS)
    assert len(list(threaded_map(lambda _: together.wait(timeout=60), range(WORKERS)))) == WORKERS


def test_an_error_then_it_is_raised_when_its_turn_comes_and_the_rest_is_not_begun():
    begun = []

    def task(item):
        begun.append(item)
        return 1 // (3 - item)

    results = threaded_map(task, range(1000))
    assert [next(results) for _ in range(3)] == [0, 0, 1]
    with pytest.raises(ZeroDivisionError):
        next(results)
    assert len(begun) <= 3 + WORKERS + 2


def test_given_results_that_are_not_asked_for_then_what_was_begun_ends():
    done = []
    results = threaded_map(done.append, range(1000))
    next(results)
    results.close()
    assert len(done) <= WORKERS + 2
