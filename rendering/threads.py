"""The threads that rendering and prediction share out their work to."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import AbstractContextManager
from functools import cache
from typing import Any

from threadpoolctl import ThreadpoolController

WORKERS = 2
"""Threads of our own, each with transforms and products of its own."""


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
    limits: AbstractContextManager[object] = _controller().limit(limits=1, user_api="blas")
    return limits


@cache
def _controller() -> ThreadpoolController:
    # Looking for the libraries takes as long as rendering half a second of a scene's blocks.
    return ThreadpoolController()
