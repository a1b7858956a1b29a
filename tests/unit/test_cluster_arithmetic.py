"""What a prediction from a large bank costs on paper, and the page that says so."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.cluster import FFT_SAMPLES, WORKS, Work, cores_that_one_disk_feeds, page, size, span, table


def test_bytes_are_those_of_the_arrays_themselves() -> None:
    work = Work(positions=7, actuators=3, taps=11, samples=50)
    assert work.bank_bytes == np.zeros((7, 3, 11), np.float32).nbytes
    assert work.field_bytes == np.zeros((7, 60), np.float32).nbytes
    assert work.row_bytes == np.zeros((3, 11)).nbytes + np.zeros((3, FFT_SAMPLES // 2), np.complex128).nbytes
    assert work.blocks == 1
    assert Work(1, 1, taps=2000, samples=5000).blocks == 3


def test_operations_grow_with_positions_and_actuators_alone() -> None:
    some, more, wide = Work(100, 20), Work(300, 20), Work(100, 2000)
    assert more.transforms == pytest.approx(3 * some.transforms)
    assert more.products == pytest.approx(3 * some.products)
    assert wide.products == pytest.approx(100 * some.products)
    assert 80 * some.transforms < wide.transforms < 100 * some.transforms  # blocks back do not grow with actuators


def test_the_table_has_a_cell_for_every_bank_and_the_time_that_the_rate_gives() -> None:
    lines = table(2e9)
    assert lines[0] == "| what | 1500 x 20 | 10,000 x 20 | 10,000 x 10,000 |"
    assert {line.count("|") for line in lines} == {len(WORKS) + 2}
    assert "| 0.24 GB | 1.6 GB | 800 GB |" in lines[2]
    large = WORKS["10,000 x 10,000"]
    assert f"{(large.transforms + large.products) / 2e9 / 3600:.2g} hours" in lines[-1]
    # Twice the rate, half the cores until the disk is what is waited for.
    assert cores_that_one_disk_feeds(4e9) == pytest.approx(cores_that_one_disk_feeds(2e9) / 2)


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        (size(8e11), "800 GB"),
        (size(42e6), "42 MB"),
        (span(1.6), "1.6 s"),
        (span(800), "13 min"),
        (span(9e3), "2.5 hours"),
    ],
)
def test_sizes_and_times_are_told_in_words(told: str, expected: str) -> None:
    assert told == expected


def test_the_page_says_where_what_was_written_differs() -> None:
    one = {"wall_s": 9.0, "starting_s": 2.0, "processor_s": 8.0, "peak_mb": 250.0, "sha256": "a"}
    figures = {
        "positions": 200,
        "recorded": 3,
        "bank_bytes": 32_000_000,
        "limit_mb": 768,
        "processors": 2,
        "load": 3.14,
        "rows": {"predict": {"here": one, "2 workers": one | {"sha256": "b"}}},
        "gain_of_two_workers": {"predict": 1.8},
        "operations_per_s": 1e9,
    }
    lines = page(figures)
    assert "| predict | here | 9.0 | 2.0 | 8.0 | 250 MB | yes |" in lines
    assert "| predict | 2 workers | 9.0 | 2.0 | 8.0 | 250 MB | **no** |" in lines
    assert "Speed of two workers over that of one, starting aside: predict 1.80." in lines
    assert "2 processors, which other programs kept busy with a load of 3.1" in lines[0]
    assert set(table(1e9)) <= set(lines)
