"""Limits on linear algebra that several contexts hold, and that none may leave behind."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

from wavefocus.calibration.blas import one_blas_thread


def _threads() -> set[int]:
    np.dot(np.ones((2, 2)), np.ones((2, 2)))
    return {int(one["num_threads"]) for one in threadpool_info() if one["user_api"] == "blas"}


def test_generators_that_end_out_of_order_then_the_limit_is_put_back_by_the_last() -> None:
    def blocks() -> Iterator[int]:
        with one_blas_thread():
            yield 1

    with threadpool_limits(limits=2, user_api="blas"):
        before = _threads()
        first, second = blocks(), blocks()
        next(first)
        next(second)
        assert _threads() == {1}
        first.close()
        assert _threads() == {1}
        second.close()
        assert _threads() == before
