"""Benchmarks: harness, conditions of a run, and a registry of modules that exist."""

import json
from importlib.util import find_spec
from pathlib import Path

from wavefocus.benchmarks import BENCHMARKS
from wavefocus.benchmarks.harness import Entry, Findings, Mark, Times, conditions, load


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
