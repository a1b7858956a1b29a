"""Benchmarks: harness, conditions of a run, and a registry of modules that exist."""

import json
from importlib.util import find_spec
from pathlib import Path

import pytest

from wavefocus.benchmarks import BENCHMARKS
from wavefocus.benchmarks.harness import Entry, Findings, Mark, Times, draw_diagrams
from wavefocus.benchmarks.machine import conditions, load


def test_every_registered_benchmark_is_a_module():
    assert all(find_spec(f"wavefocus.benchmarks.{name}") is not None for name in BENCHMARKS)


def test_conditions_are_plain_and_name_no_place_of_this_machine():
    found = conditions("wavefocus bench bank")
    text = json.dumps(found)
    assert str(Path.cwd()) not in text
    assert str(Path.home()) not in text or str(Path.home()) == "/"
    assert found["cores"] >= 1
    assert "numpy" in found["packages"]
    assert load() is None or load() >= 0


def test_points_are_written_as_json_and_tables_with_their_marks(tmp_path):
    marks = (Mark("error", 1e-3, at_most=True), Mark("times", 5.0))
    points = [
        Entry(work="w", method="peer", timing=Times(2.0, 2.0)),
        Entry(work="w", method="ours", parameters={"step_mm": 4.0}, error=1e-4, timing=Times(1.0, 1.0), marks=marks)
        .against(Times(2.0, 2.0)),
    ]  # fmt: skip
    findings = Findings(points, "the truth")
    written = json.loads(findings.write(tmp_path, "some", {"quick": False}).read_text(encoding="utf-8"))
    assert [one["met"] for one in written["marks"]] == [True, False]
    assert written["points"][1]["step_mm"] == 4.0
    assert [one["method"] for one in written["points"]] == ["peer", "ours"]
    assert written["points"][1]["error"] == 1e-4
    assert any("**not met**" in line for line in findings.lines())
    assert not any("met" in line.split("|")[-2] for line in findings.lines(judged=False) if line.startswith("| ours"))
    assert points[1].met is False


@pytest.mark.parametrize("value", [None, 3.0])
def test_a_mark_of_a_figure_that_was_not_measured_is_not_judged(value):
    point = Entry(work="w", method="m", figures={"hours": value}, marks=(Mark("hours", 2.0, at_most=True),))
    assert point.judged(point.marks[0]) is (None if value is None else False)


def _precision(method: str, step: float, error: float, wall_s: float) -> Entry:
    return Entry(work="w", method=method, parameters={"step_mm": step}, error=error, timing=Times(wall_s, wall_s))


def test_a_work_of_three_errors_is_a_diagram(tmp_path):
    findings = Findings([_precision("ours", 1.0, 1e-4, 3.0), _precision("ours", 2.0, 1e-3, 1.0),
                         _precision("peer", 1.0, 1e-2, 2.0), Entry(work="too few", method="m", error=0.1)])  # fmt: skip
    assert draw_diagrams(findings, tmp_path, "some") == {"w": "some-w.png"}
    assert (tmp_path / "some-w.png").read_bytes().startswith(b"\x89PNG")
