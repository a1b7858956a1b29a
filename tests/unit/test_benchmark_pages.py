"""The pages that are written from benchmarks: what may stand there, and what a reader must know of it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.timing import conditions, load

TOOL = Path(__file__).parents[2] / "tools/benchmark_pages.py"
MADE = {
    "command": "wavefocus bench render", "date": "2026-01-02T03:04+00:00", "commit": "abc", "processor": "a processor",
    "cores": 2, "memory_gib": 8.0, "system": "Linux x86_64", "python": "3.11.2", "packages": {"numpy": "2.0"},
    "threads": {}, "load_before": 0.1, "load_after": 1.4, "seconds": 61.0,
}  # fmt: skip
RESULT = {"work": "path | 5000", "method": "ours", "wall_s": 0.5, "cpu_s": 0.4, "error": 2e-16, "times": 30.0,
          "cpu_times": 31.0, "remark": "r", "mark": None}  # fmt: skip
MARK = {"figure": "times", "value": 25.0, "at_most": False, "measured": None, "work": "path | 5000", "method": "ours"}
POINT = {"method": "sampled", "step_mm": 4.0, "tolerance_db": None, "wall_s": 1.0, "cpu_s": 1.0, "error": 0.4}
RENDER: dict[str, Any] = {
    "quick": False, "made": MADE, "results": [RESULT], "precision": [POINT],
    "marks": [{**MARK, "met": True}, {**MARK, "value": 100.0, "met": False}],
}  # fmt: skip


def written(folder: Path, **figures: dict[str, Any]) -> tuple[int, str, str]:
    """Exit code, what was told, and the page."""
    (folder / "out").mkdir()
    for place in ("docs/reference", "docs/pictures"):
        (folder / place).mkdir(parents=True)
    for name, one in figures.items():
        (folder / "out" / f"{name}.json").write_text(json.dumps(one), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, str(TOOL), "out"], cwd=folder, capture_output=True, text=True, check=False, timeout=60
    )
    page = folder / "docs/reference/benchmarks.md"
    return done.returncode, done.stderr, page.read_text(encoding="utf-8") if page.exists() else ""


def test_given_figures_then_the_page_has_them_with_their_marks_and_conditions(tmp_path: Path) -> None:
    code, told, page = written(tmp_path, render=RENDER, other={"quick": False, "made": MADE, "deep": {"er": 1234.5}})
    assert (code, told) == (0, "")
    assert "| path \\| 5000 | ours | times at least 25 | 30 | met |" in page
    assert "| path \\| 5000 | ours | times at least 100 | 30 | **not met** |" in page
    assert "a processor, 2 cores, 8.0 GiB, Linux x86_64" in page
    assert "| deep, er | 1234 |" in page
    assert "**busy**" not in page


def test_given_a_busy_machine_then_the_page_says_so(tmp_path: Path) -> None:
    page = written(tmp_path, render={**RENDER, "made": {**MADE, "load_before": 1.7}})[2]
    assert "1.7, 1.4 (**busy**" in page


@pytest.mark.parametrize(
    ("figures", "why"),
    [
        ({"render": {**RENDER, "quick": True}}, "quick"),
        ({"render": {key: value for key, value in RENDER.items() if key != "quick"}}, "quick"),
        ({"render": {key: value for key, value in RENDER.items() if key != "made"}}, "how it was made"),
        ({}, "no figures"),
    ],
)
def test_given_figures_that_say_nothing_then_no_page_is_written(
    tmp_path: Path, figures: dict[str, Any], why: str
) -> None:
    code, told, page = written(tmp_path, **figures)
    assert code == 1
    assert why in told
    assert told.count("\n") == 1
    assert page == ""


def test_conditions_are_plain_and_name_no_place_of_this_machine() -> None:
    found = conditions("wavefocus bench bank")
    text = json.dumps(found)
    assert str(Path.cwd()) not in text
    assert str(Path.home()) not in text or str(Path.home()) == "/"
    assert found["cores"] >= 1
    assert "numpy" in found["packages"]
    assert load() is None or load() >= 0
