"""Each class of fault on a small plate: no position ends wrong and valid."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system.fault_plate import CoarsePlate, FaultCase
from wavefocus.__main__ import run

SCHEDULES = ["sequential", "staggered"]


@pytest.fixture(scope="module")
def small_plate(tmp_path_factory: pytest.TempPathFactory) -> CoarsePlate:
    """Six positions, whose truth and undisturbed measurements are made once."""
    return CoarsePlate(tmp_path_factory.mktemp("plate"), columns=3, rows=2, faulty=3)


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize(("kind", "level_db"), [("faint_reference", -0.3), ("faint_reference", 6.0), ("dark", 0.0)])
def test_given_a_fault_in_one_record_of_half_the_positions_then_none_ends_wrong_and_valid(
    small_plate: CoarsePlate, schedule: str, kind: str, level_db: float
) -> None:
    for always in (False, True):
        found = small_plate.outcome(FaultCase(kind, level_db, schedule, always))
        assert (found.faulty, found.wrong, found.alarms) == (3, 0, 0)
        assert found.valid == (0 if always else 3)


def test_given_another_level_in_one_record_of_some_positions_then_neighbours_show_it_and_a_repeat_or_the_status_says_so(
    tmp_path: Path,
) -> None:
    plate = CoarsePlate(tmp_path, columns=5, rows=5, faulty=4)
    once = plate.outcome(FaultCase("drift", -3.0, "sequential", always=False))
    assert (once.faulty, once.valid, once.wrong, once.alarms) == (4, 4, 0, 0)
    bank = tmp_path / "plate.h5"
    before = bank.read_bytes()
    assert run(["resume", str(bank)]) == 0
    assert bank.read_bytes() == before
    assert run(["check", str(bank)]) == 0
    always = plate.outcome(FaultCase("drift", -3.0, "sequential", always=True))
    assert (always.valid, always.wrong, always.alarms) == (0, 0, 0)
