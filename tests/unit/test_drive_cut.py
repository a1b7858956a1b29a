"""Drives in blocks."""

from __future__ import annotations

import numpy as np
import pytest

from rendering.drive.drive_cut import CutDrive


@pytest.mark.parametrize(("dtype", "precision"), [(np.float64, 1e-15), (np.float32, 2e-7)])
@pytest.mark.parametrize("exponent", [0, -18, 25, -900, 1015, -1060])
@pytest.mark.parametrize(("hop", "fade"), [(100, 0), (100, 30), (720, 50)])
def test_blocks_add_up_to_the_drive_at_size_one(dtype, precision, exponent, hop, fade):
    volts = np.random.default_rng(0).standard_normal((5, 730))
    drive = CutDrive(np.ldexp(volts, exponent), exponent)
    # Numbers that small hold fewer digits.
    expected = np.ldexp(np.ldexp(volts, exponent), -exponent)
    total = np.zeros((3, 900))
    for block in range(-(-730 // hop)):
        cut = np.full((3, hop + fade + 20), np.nan, dtype=dtype)
        drive.cut(block, hop, fade, cut, slice(1, 4))
        end = min(block * hop + cut.shape[1], 900)
        total[:, block * hop : end] += cut[:, : end - block * hop]
    np.testing.assert_allclose(total[:, :730], expected[1:4], rtol=0, atol=4 * precision)
    assert not total[:, 730:].any()


def test_a_block_fades_in_as_the_one_before_fades_out():
    drive = CutDrive(np.ones((1, 400)), 0)
    first, second = np.empty((1, 130)), np.empty((1, 130))
    drive.cut(0, 100, 30, first)
    drive.cut(1, 100, 30, second)
    assert (first[0, :100] == 1).all()
    assert (np.diff(first[0, 100:]) < 0).all()
    np.testing.assert_allclose(first[0, 100:] + second[0, :30], 1.0, rtol=1e-15)
