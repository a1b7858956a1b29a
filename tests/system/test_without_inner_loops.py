"""Without a compiler numpy does the work: renders, predictions, their bounds and the stiff cases hold all the same."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.render_workloads import jumping, modal_bank
from rendering.drive.rendering import render_with_report
from rendering.inner_loops import VARIABLE

TESTS = Path(__file__).parent.parent
HELD = (
    "drive", "field", "omission", "row_cut", "row_pages", "row_spectra", "scene_rows", "stiff_cases_rendering",
    "streamed_drive", "window_spectra", "windows",
)  # fmt: skip
RENDER = """
import sys
import numpy as np
from benchmarks.render_workloads import jumping, modal_bank
from rendering.drive.rendering import render_with_report
from rendering.inner_loops import inner_loops
assert inner_loops() is None
load = jumping(modal_bank(20, 1), 20, 300)
drive, report = render_with_report(load.scene, load.bank, tolerance_db=-60.0)
np.savez(sys.argv[1], drive_v=drive.drive_v, bound=drive.omitted_bound)
"""


def without_loops(*arguments: str, timeout_s: float) -> None:
    done = subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, VARIABLE: "numpy"},
        cwd=TESTS.parent,
        capture_output=True,
        text=True,
        check=False,
        timeout=timeout_s,
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]


@pytest.mark.long
@pytest.mark.timeout(400)
def test_the_tests_of_renders_and_predictions_pass():
    modules = [str(TESTS / "unit" / f"test_{name}.py") for name in HELD]
    without_loops("-m", "pytest", "-n", "0", "-q", "-p", "no:cacheprovider", *modules, timeout_s=390)


def test_a_render_is_that_of_the_compiled_loops_within_both_bounds(tmp_path):
    without_loops("-c", RENDER, str(tmp_path / "drive.npz"), timeout_s=100)
    load = jumping(modal_bank(20, 1), 20, 300)
    ours, _ = render_with_report(load.scene, load.bank, tolerance_db=-60.0)
    with np.load(tmp_path / "drive.npz") as theirs:
        apart = np.linalg.norm(ours.drive_v - theirs["drive_v"]) / np.linalg.norm(ours.drive_v)
        # Either may be wrong by its bound, and what they leave out is the same, so that rounding alone differs.
        assert apart <= 1e-5
        np.testing.assert_allclose(ours.omitted_bound, theirs["bound"], rtol=0.05)
