"""The threads that rendering and prediction share out their work to."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from typing import Any
from weakref import WeakKeyDictionary

from threadpoolctl import ThreadpoolController

from calibration.blas import SharedLimits
from rendering.freed_memory import keep_freed_memory

WORKERS = 2
"""Threads of our own, each with transforms and products of its own."""


@contextmanager
def workers() -> Iterator[Executor]:
    """Lend the threads of our own; when they are given back, what was not begun is dropped, and the rest has ended.

    They are kept: to start threads takes as long as to render a second of a scene.
    """
    given: WeakKeyDictionary[Future[Any], _Call] = WeakKeyDictionary()
    try:
        yield _Lent(_threads(os.getpid()), given)
    finally:
        begun = []
        for future, call in tuple(given.items()):
            if future.cancel():
                # A thread will come by it some time.
                call.let_go()
            else:
                begun.append(future)
        wait(begun)


@cache
def _threads(process: int) -> ThreadPoolExecutor:
    # A process that was forked has none of its parent's.
    keep_freed_memory()
    return ThreadPoolExecutor(WORKERS, thread_name_prefix="render")


class _Lent(Executor):
    """Hands on what it is given, and keeps an eye on it."""

    def __init__(self, threads: Executor, given: WeakKeyDictionary[Future[Any], _Call]) -> None:
        self._threads = threads
        self._given = given

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """What will come of it."""
        call = _Call(fn, args, kwargs)
        future = self._threads.submit(call)
        self._given[future] = call
        return future


class _Call:
    """A call that lets go of all that it was given before it is told to have ended.

    A thread would hold on to it a little longer, and so keep memory from being used again.
    """

    def __init__(self, fn: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        self._given: list[Any] = [fn, args, kwargs]

    def __call__(self) -> Any:
        fn, args, kwargs = self._given
        self.let_go()
        return fn(*args, **kwargs)

    def let_go(self) -> None:
        """Hold on to nothing."""
        self._given.clear()


class AtOnce(Executor):
    """Does what it is given at once, in the thread that gives it."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """What came of it."""
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


def one_blas_thread() -> AbstractContextManager[object]:
    """Hold BLAS to one thread while the context lasts, as `calibration.blas` does, at no cost per call.

    Idle BLAS threads wait by spinning, and would take the cores away from ours.
    """
    return _one_thread.held()


@cache
def _controller() -> ThreadpoolController:
    # Looking for the libraries takes as long as rendering half a second of a scene's blocks.
    return ThreadpoolController()


_one_thread = SharedLimits(lambda: _controller().limit(limits=1, user_api="blas"))
