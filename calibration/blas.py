"""How many threads linear algebra may use."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Protocol

from threadpoolctl import ThreadpoolController


class Limits(Protocol):
    """Limits in force, as threadpoolctl sets them."""

    def restore_original_limits(self) -> None:
        """Put back what was before."""
        ...


class SharedLimits:
    """Limits held by several contexts: set by the first, put back by the last, in whatever order they end.

    limit: Sets the limits.
    """

    def __init__(self, limit: Callable[[], Limits]) -> None:
        self._limit, self._lock = limit, threading.Lock()
        self._holders = 0
        self._limits: Limits | None = None

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold them while the context lasts."""
        with self._lock:
            if self._limits is None:
                self._limits = self._limit()
            self._holders += 1
        try:
            yield
        finally:
            with self._lock:
                self._holders -= 1
                if self._holders == 0:
                    self._limits.restore_original_limits()
                    self._limits = None


@cache
def _controller() -> ThreadpoolController:
    # Looking for the libraries takes some milliseconds.
    return ThreadpoolController()


_one_thread = SharedLimits(lambda: _controller().limit(limits=1, user_api="blas"))


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Hold BLAS to one thread while the context lasts.

    Our matrices are small and our own threads use the cores: idle BLAS threads, which wait by spinning, would
    take them away. The order of sums, so the last bits of every estimate, would also depend on how many
    there are, and a resumed bank must be byte-identical.
    """
    with _one_thread.held():
        yield
