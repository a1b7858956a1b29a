"""How many threads linear algebra may use."""

from __future__ import annotations

from contextlib import AbstractContextManager

from threadpoolctl import threadpool_limits


def one_blas_thread() -> AbstractContextManager[object]:
    """Hold BLAS to one thread while the context lasts.

    Our matrices are small and our own threads use the cores: idle BLAS threads, which wait by spinning, would
    take them away. The order of sums, so the last bits of every estimate, would also depend on how many
    there are, and a resumed bank must be byte-identical.
    """
    limits: AbstractContextManager[object] = threadpool_limits(limits=1, user_api="blas")
    return limits
