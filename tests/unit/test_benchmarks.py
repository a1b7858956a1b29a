"""Benchmarks: conditions of a run, and a registry of modules that exist."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path

import pytest

from benchmarks import BENCHMARKS
from benchmarks.timing import conditions, load


@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_registered_benchmark_is_a_module(name: str) -> None:
    assert find_spec(f"benchmarks.{name}") is not None


def test_conditions_are_plain_and_name_no_place_of_this_machine() -> None:
    found = conditions("wavefocus bench bank")
    text = json.dumps(found)
    assert str(Path.cwd()) not in text
    assert str(Path.home()) not in text or str(Path.home()) == "/"
    assert found["cores"] >= 1
    assert "numpy" in found["packages"]
    assert load() is None or load() >= 0
