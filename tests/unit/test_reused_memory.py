"""Memory that is kept from one render to the next."""

from __future__ import annotations

import gc
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from rendering import reused_memory
from rendering.reused_memory import MOST_SPARE, STEP, reused, spare_bytes


@pytest.fixture(autouse=True)
def no_spare_memory():
    gc.collect()
    reused_memory._spare.clear()


def address(array: np.ndarray) -> int:
    return int(array.__array_interface__["data"][0])


@pytest.mark.parametrize("dtype", [np.float64, np.complex64])
@pytest.mark.parametrize("shape", [(3, 5), (1,), (0, 4), (2, 3, 4)])
def test_an_array_is_as_asked_for(shape, dtype):
    array = reused(shape, dtype)
    assert array.shape == shape
    assert array.dtype == dtype
    assert array.flags.c_contiguous
    assert array.flags.writeable
    array[...] = 7
    assert (array == 7).all()


def test_memory_is_used_again_when_the_array_is_gone():
    array = reused((100, 1000), np.float64)
    where = address(array)
    del array
    assert spare_bytes() == STEP
    again = reused((90, 1000), np.float64)
    assert address(again) == where
    assert spare_bytes() == 0


@pytest.mark.parametrize("view", [lambda a: a[3:5], lambda a: a.T, lambda a: a.ravel()[7:], memoryview])
def test_memory_is_kept_while_any_view_lives(view):
    array = reused((100, 1000), np.float64)
    array[...] = 1.5
    part = view(array)
    del array
    other = reused((100, 1000), np.float64)
    other[...] = -1.0
    assert (np.asarray(part) == 1.5).all()


def test_the_smallest_that_is_large_enough_is_taken():
    arrays = [reused((size,), np.uint8) for size in (5 * STEP, 2 * STEP, 3 * STEP)]
    wanted = address(arrays[2])
    arrays.clear()
    assert address(reused((3 * STEP - 1,), np.uint8)) == wanted


def test_no_more_than_so_much_is_kept():
    arrays = [reused((MOST_SPARE // 4,), np.uint8) for _ in range(7)]
    arrays.clear()
    assert spare_bytes() == MOST_SPARE


def test_threads_never_share_memory():
    def fill(number: int) -> bool:
        for _ in range(200):
            array = reused((1000,), np.int64)
            array[...] = number
            if not (array == number).all():
                return False
        return True

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(fill, range(8)))
