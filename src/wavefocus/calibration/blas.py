"""One thread for linear algebra."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from threadpoolctl import ThreadpoolController


class _OneThread:
    """A limit held by several threads: set by the first, put back by the last, in whatever order they end."""

    def __init__(self) -> None:
        self._lock, self._holders = threading.Lock(), 0
        self._libraries: Any = None
        self._limits: Any = None

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold BLAS to one thread while the context lasts.

        Our matrices are small and our own threads use the cores: idle BLAS threads, which wait by spinning, would
        take them away. The order of sums, so the last bits of every estimate, would also depend on how many
        there are, and a resumed bank must be byte-identical.
        """
        with self._lock:
            if self._holders == 0:
                # Looking for the libraries takes some milliseconds, which are spent once.
                self._libraries = self._libraries or ThreadpoolController()
                self._limits = self._libraries.limit(limits=1, user_api="blas")
            self._holders += 1
        try:
            yield
        finally:
            with self._lock:
                self._holders -= 1
                if self._holders == 0:
                    self._limits.restore_original_limits()


one_blas_thread = _OneThread().held
