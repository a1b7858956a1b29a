"""What is left out of rows is chosen from as few of them as tell."""

from __future__ import annotations

import numpy as np

from rendering.drive.band_choice import Sample
from rendering.drive.truncation import choose_cut

ACTUATORS, TAPS, FFT = 4, 64, 128
ROWS = [[0, 1, 2], [3, 4, 5]]


def samples() -> list[Sample]:
    """Two blocks of three windows, each flat over the bins, like the rows."""
    flat = np.ones((3, FFT // 2 + 1))
    return [Sample(flat, flat, 1.0, np.zeros(3)) for _ in range(2)]


def chosen(green: np.ndarray, tolerance: float):
    """The cut of rows that are all alike, what it spends, and which rows were read."""
    read: list[int] = []

    def reading(row: int) -> np.ndarray:
        read.append(row)
        return green

    cut, spent = choose_cut(samples(), ROWS, reading, green.shape, FFT, 2, tolerance)
    return cut, spent, read


def test_given_late_taps_and_actuators_that_all_count_then_one_row_tells():
    cut, spent, read = chosen(np.ones((ACTUATORS, TAPS), dtype=np.float32), 1e-3)
    assert cut.whole
    assert spent == 0.0
    assert read == [0]


def test_given_late_taps_and_an_actuator_that_hardly_count_then_they_are_left_out_after_a_look_at_all_rows():
    green = np.ones((ACTUATORS, TAPS), dtype=np.float32)
    green[2] = 1e-9
    green[:, TAPS // 2 :] = 1e-9
    cut, spent, read = chosen(green, 1e-3)
    assert cut.actuators.tolist() == [0, 1, 3]
    assert cut.taps == TAPS // 2
    assert 0.0 < spent < 1e-3
    assert read == [0, 1, 2, 3, 4, 5]


def test_given_one_row_whose_late_taps_count_then_all_taps_are_kept():
    quiet = np.ones((ACTUATORS, TAPS), dtype=np.float32)
    quiet[:, TAPS // 2 :] = 1e-9
    loud = np.ones((ACTUATORS, TAPS), dtype=np.float32)
    cut, _ = choose_cut(samples(), ROWS, lambda row: loud if row == 5 else quiet, quiet.shape, FFT, 2, 1e-3)
    assert cut.whole


def test_given_silence_then_nothing_is_read_and_all_is_kept():
    nothing = np.zeros((3, FFT // 2 + 1))
    cut, spent = choose_cut(
        [Sample(nothing, nothing, 1.0, np.zeros(3))], [[0, 1, 2]], {}.__getitem__, (4, 64), FFT, 2, 1e-3
    )
    assert cut.whole
    assert spent == 0.0
