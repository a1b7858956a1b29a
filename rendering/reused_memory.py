"""Memory that is kept from one render to the next: to touch it for the first time can take longer than to compute."""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

MOST_SPARE = 96 * 2**20
"""Most bytes that are kept while nobody uses them."""
STEP = 2**20
"""Sizes are multiples of this, so that memory fits again for something like it."""

_spare: deque[NDArray[np.uint8]] = deque()
_taking = threading.Lock()


def reused(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """An array that is not initialised; its memory is used again when it and all its views are gone.

    Parameters
    ----------
    shape : tuple of int
        Its shape.
    dtype : dtype
        Its type.
    """
    return np.asarray(_Lease(shape, np.dtype(dtype)))


def spare_bytes() -> int:
    """How much is kept now."""
    return sum(len(memory) for memory in tuple(_spare))


class _Lease:
    """What an array and its views hold on to."""

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self._memory = _take(int(np.prod(shape, dtype=np.int64)) * dtype.itemsize)
        self.__array_interface__ = {
            "version": 3,
            "shape": shape,
            "typestr": dtype.str,
            "data": (self._memory.ctypes.data, False),
        }

    def __del__(self) -> None:
        memory = getattr(self, "_memory", None)
        # Without a lock: garbage may be collected at any time, within `_take` too.
        if memory is not None and spare_bytes() + len(memory) <= MOST_SPARE:
            _spare.append(memory)


def _take(size: int) -> NDArray[np.uint8]:
    """The smallest of what is kept that is large enough, or new memory."""
    with _taking:
        kept = sorted((_spare.popleft() for _ in range(len(_spare))), key=len)
        found = next((memory for memory in kept if len(memory) >= size), None)
        _spare.extend(memory for memory in kept if memory is not found)
    return np.empty(max(1, -(-size // STEP)) * STEP, dtype=np.uint8) if found is None else found
