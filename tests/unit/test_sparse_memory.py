"""A file in memory that holds what was written and nothing for what was not."""

from __future__ import annotations

import io

from hypothesis import given
from hypothesis import strategies as st

from storage.sparse_memory import SparseMemory


@given(writes=st.lists(st.tuples(st.integers(0, 20_000), st.binary(min_size=1, max_size=9000)), max_size=6))
def test_writes_anywhere_then_read_back_as_from_any_file(writes: list[tuple[int, bytes]]) -> None:
    memory, expected = SparseMemory(), io.BytesIO()
    for offset, data in writes:
        for file in (memory, expected):
            file.seek(offset)
            file.write(data)
    whole = expected.getvalue()
    assert memory.size == len(whole)
    memory.seek(0)
    assert memory.read() == whole
    rebuilt = bytearray(len(whole))
    for offset, page in memory.written():
        rebuilt[offset : offset + len(page)] = page
    assert rebuilt == whole


def test_a_far_end_then_takes_no_memory_and_reads_as_zeros() -> None:
    memory = SparseMemory()
    memory.write(b"front")
    memory.truncate(1 << 40)
    memory.seek(-3, io.SEEK_END)
    assert memory.read(10) == bytes(3)
    assert [offset for offset, _ in memory.written()] == [0]


def test_a_file_cut_short_then_writes_nothing_past_its_end() -> None:
    memory = SparseMemory()
    memory.write(bytes(range(256)) * 40)
    memory.truncate(5000)
    assert [(offset, len(page)) for offset, page in memory.written()] == [(0, 4096), (4096, 904)]
