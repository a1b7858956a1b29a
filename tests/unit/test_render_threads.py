"""The threads that rendering keeps."""

from __future__ import annotations

import subprocess
import sys
import threading
import weakref

import pytest

from rendering.threads import WORKERS, workers


def test_given_one_use_after_another_then_the_threads_are_the_same():
    def idents():
        together = threading.Barrier(WORKERS)

        def ident():
            together.wait(timeout=60)
            return threading.get_ident()

        with workers() as threads:
            return {future.result() for future in [threads.submit(ident) for _ in range(WORKERS)]}

    first = idents()
    assert len(first) == WORKERS
    assert idents() == first


def test_given_an_error_then_what_was_begun_has_ended_and_the_rest_is_not_done():
    begun, done, go_on = threading.Barrier(WORKERS + 1), [], threading.Event()

    def task(number):
        begun.wait(timeout=60)
        go_on.wait(timeout=60)
        done.append(number)

    waiting = []

    def fail_amid_work():
        with workers() as threads:
            for number in range(WORKERS):
                threads.submit(task, number)
            waiting.extend(threads.submit(done.append, "late") for _ in range(10))
            begun.wait(timeout=60)
            threading.Timer(0.05, go_on.set).start()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_amid_work()
    assert sorted(done) == list(range(WORKERS))
    assert all(future.cancelled() for future in waiting)


def test_given_a_call_that_was_not_begun_then_it_holds_on_to_nothing():
    go_on = threading.Event()
    with workers() as busy:
        for _ in range(WORKERS):
            busy.submit(go_on.wait, 60)
        with workers() as threads:
            given = threading.Event()
            gone = weakref.ref(given)
            threads.submit(given.wait)
            del given
        # Its place in the queue is still there, as all threads wait.
        assert gone() is None
        go_on.set()


def test_given_two_uses_at_once_then_both_come_to_an_end():
    with workers() as some, workers() as others:
        futures = [threads.submit(pow, 2, number) for number in range(50) for threads in (some, others)]
        assert [future.result(60) for future in futures] == [2**number for number in range(50) for _ in "ab"]


@pytest.mark.skipif(sys.platform == "win32", reason="there is no fork")
def test_given_a_process_that_was_forked_then_it_has_threads_of_its_own():
    code = """
import os, sys, warnings
from rendering.threads import workers
with workers() as threads:
    assert threads.submit(int, "7").result(60) == 7
warnings.simplefilter("ignore")
child = os.fork()
with workers() as threads:
    assert threads.submit(int, "8").result(60) == 8
if child:
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=120).returncode == 0
