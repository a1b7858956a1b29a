"""Grids too coarse for neighbours: a second measurement confirms each position."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.system.lines import Lines
from wavefocus.__main__ import run

RIG = """
[rig]
name = "virtual"
[actuators]
position_mm = [[119.0, 0.0], [0.0, 69.0], [-119.0, 0.0], [0.0, -69.0]]
"""
RUN = """
rig = "rig.toml"
[grid]
spacing_mm = 40.0
check_positions = 0
[sweep]
duration_s = 0.3
amplitude_v = 3.0
[capture]
averages = 2
decay_s = 0.1
taps = 1000
excitation = "{schedule}"
when_staggered_does_not_pay = "keep"
[quality]
{quality}
[virtual]
seed = 5
noise_v = {noise_v}
"""
FAULTY = (1, 4, 5, 9)


def captured(
    folder: Path, schedule: str, records: dict[int, int], *, look: bool, level_db: float = 0.0, noise_v: float = 1e-4
) -> tuple[np.ndarray, np.ndarray]:
    folder.mkdir()
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    text = RUN.format(schedule=schedule, quality="" if look else 'second_look = "never"', noise_v=noise_v)
    for position, record in records.items():
        text += (
            f'[[virtual.fault_plan]]\nrole = "recorder"\noperation = "read"\nkind = "drift"\nlevel_db = {level_db}\n'
            f'position = {position}\nrecord = {record}\ncount = 1\npurpose = "capture"\n'
        )
    (folder / "run.toml").write_text(text, encoding="utf-8")
    assert run(["capture", str(folder / "run.toml"), "--bank", str(folder / "plate.h5")]) == 0
    with h5py.File(folder / "plate.h5", "r") as file:
        return file["green"][...].astype(np.float64), file["status"][...]


def gains(rows: np.ndarray, clean: np.ndarray) -> np.ndarray:
    """Level of each row over that of another measurement; noise hardly counts."""
    return np.sum(rows * clean, axis=2) / np.sum(clean * clean, axis=2)


@pytest.mark.parametrize(("schedule", "level_db"), [("sequential", -0.5), ("staggered", -20.0)])
def test_given_a_coarse_grid_then_a_second_look_replaces_rows_of_another_level(
    tmp_path: Path, schedule: str, level_db: float
) -> None:
    clean, _ = captured(tmp_path / "clean", schedule, {}, look=False, noise_v=0.0)
    strength = np.linalg.norm(clean, axis=2)
    loudest = {position: int(np.argmax(strength[position])) for position in FAULTY}
    records = loudest if schedule == "sequential" else dict.fromkeys(FAULTY, 0)
    once, status_once = captured(tmp_path / "once", schedule, records, look=False, level_db=level_db)
    twice, status = captured(tmp_path / "twice", schedule, records, look=True, level_db=level_db)
    # What this is for: neighbours see few of them.
    wrong = [abs(gains(once, clean)[position, actuator] - 1.0) > 0.04 for position, actuator in loudest.items()]
    assert any(wrong)
    assert (status_once == 1).all()
    assert (status == 1).all()
    assert gains(twice, clean)[strength > 0.2 * strength.max(axis=1, keepdims=True)] == pytest.approx(1.0, abs=0.02)


# All of the grid's 14 positions are marked before the pass begins.
@pytest.mark.parametrize(
    ("schedule", "event", "number"), [("sequential", "position_committed", 15), ("staggered", "position_started", 19)]
)
def test_given_a_kill_while_positions_are_marked_or_in_the_second_look_then_the_bank_ends_as_an_undisturbed_one(
    tmp_path: Path, schedule: str, event: str, number: int
) -> None:
    captured(tmp_path / "quiet", schedule, {}, look=True)
    quiet = (tmp_path / "quiet" / "plate.h5").read_bytes()
    bank = tmp_path / "killed.h5"
    with Lines("capture", tmp_path / "quiet" / "run.toml", "--bank", bank, "--json") as killed:
        for _ in range(number):
            killed.hear(event)
        killed.process.kill()
    with h5py.File(bank, "r", locking=False) as file:
        assert (file["status"][...] != 0).all()
    for _ in range(2):
        assert run(["resume", str(bank)]) == 0
        assert bank.read_bytes() == quiet


def test_given_fewer_positions_than_neighbours_then_each_is_measured_twice_and_the_plan_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    captured(tmp_path / "lab", "sequential", {}, look=True)
    with h5py.File(tmp_path / "lab" / "plate.h5", "r") as file:
        assert (file["quality/attempts"][...] == 4).all()
        positions = len(file["status"])
    capsys.readouterr()
    assert run(["plan", str(tmp_path / "lab" / "run.toml"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["second_looks"] == facts["positions"] == positions
