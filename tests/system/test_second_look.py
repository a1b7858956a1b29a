"""Grids too coarse for neighbours: a second measurement confirms each position."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

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
second_look = "{look}"
[virtual]
seed = 5
noise_v = {noise_v}
"""
FAULTY = (1, 4, 5, 9)


def captured(
    folder: Path, schedule: str, records: dict[int, int], *, look: bool, level_db: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    folder.mkdir()
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    noise_v = 1e-4 if records else 0.0
    text = RUN.format(schedule=schedule, look="auto" if look else "never", noise_v=noise_v)
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


@pytest.mark.parametrize("level_db", [-0.5, -1.0, -20.0])
@pytest.mark.parametrize("schedule", ["sequential", "staggered"])
def test_given_a_coarse_grid_then_a_second_look_replaces_rows_of_another_level(
    tmp_path: Path, schedule: str, level_db: float
) -> None:
    clean, _ = captured(tmp_path / "clean", schedule, {}, look=False)
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
