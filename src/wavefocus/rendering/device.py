"""Where arrays are computed, only by names of the array API: this processor and its threads, or a GPU through CuPy."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.errors import InputError

REMEDY = "install CuPy for this machine's CUDA (pip install cupy-cuda12x or -cuda13x), or leave out --device"


@dataclass(frozen=True, slots=True)
class Device:
    """A namespace of the array API, and the way back from it.

    xp: The namespace: NumPy's own, CuPy's, or another that follows the standard.
    to_host: Makes a NumPy array of one of its arrays.
    memory_bytes: Memory that row spectra may take; one part of a computation takes about as much again.
    """

    xp: Any
    to_host: Callable[[Any], NDArray[Any]]
    memory_bytes: int

    def fft(self, *, single: bool) -> Any:
        """Transforms: the namespace's own, but SciPy's for NumPy in single precision."""
        if single and self.is_host:
            import scipy.fft  # 1.5 times as fast, and 0.3 s to load

            return scipy.fft
        return self.xp.fft

    def dtype(self, kind: type[Any]) -> Any:
        """The namespace's own type for one of NumPy's."""
        return getattr(self.xp, kind.__name__)

    @property
    def is_host(self) -> bool:
        """Whether arrays are NumPy's, so that threads of this process compute side by side."""
        return self.xp is np


def fast_length(least: int) -> int:
    """Smallest transform length of at least so many samples that has no other factors than 2, 3 and 5."""
    best = 1 << max(least - 1, 0).bit_length()
    five = 1
    while five < best:
        three = five
        while three < best:
            # The smallest power of two that makes it long enough.
            best = min(best, three << max(-(-least // three) - 1, 0).bit_length())
            three *= 3
        five *= 5
    return best


def host_device() -> Device:
    """The processor that runs this, by NumPy."""
    return Device(np, np.asarray, 256 * 2**20)


def cuda_device() -> Device:
    """The first GPU that CUDA sees, by CuPy. Raises InputError: CuPy is missing, or it finds no GPU."""
    try:
        import cupy
    except ImportError as error:
        raise InputError(f"--device cuda needs CuPy ({error}): {REMEDY}") from None
    try:
        count = int(cupy.cuda.runtime.getDeviceCount())
        free_bytes = int(cupy.cuda.runtime.memGetInfo()[0]) if count else 0
    except Exception as error:  # CuPy's errors are its own, and differ between its versions
        raise InputError(f"--device cuda: CUDA says {' '.join(str(error).split())}; {REMEDY}") from None
    if not count:
        raise InputError(f"--device cuda: there is no GPU; {REMEDY}")
    return Device(cupy, cupy.asnumpy, free_bytes // 8)


Item = TypeVar("Item")
Result = TypeVar("Result")

WORKERS = 2


def threaded_map(task: Callable[[Item], Result], items: Iterable[Item], workers: int = WORKERS) -> Iterator[Result]:
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
