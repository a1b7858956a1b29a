"""Threads that rendering and prediction share their work among."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

WORKERS = 2


def in_order(task: Callable[[Item], Result], items: Iterable[Item], workers: int = WORKERS) -> Iterator[Result]:
    """Results of a task for each item, in the items' order, computed by threads at most `workers` items ahead.

    An error is raised when its result is due; what was not begun is dropped.

    task: Called by several threads at a time.
    items: Taken one by one in the calling thread, as results are asked for.
    workers: Threads; with one, the calling thread does the work.
    """
    if workers == 1:
        yield from map(task, items)
        return
    pool = ThreadPoolExecutor(workers, thread_name_prefix="render")
    try:
        pending: deque[Future[Result]] = deque()
        for item in items:
            pending.append(pool.submit(task, item))
            if len(pending) > workers:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
